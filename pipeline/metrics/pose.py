"""Errors of estimated camera poses against ground truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.geometry.similarity import Similarity, umeyama
from pipeline.io.names import NameIndex
from pipeline.runtime.json_file import JsonObject
from pipeline.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

AUC_DEGREES = (1.0, 5.0, 10.0)


class PoseError(JsonObject):
    """Pose errors after aligning the estimated centres to the true ones by a similarity.

    Rotations are null without a common image, centres for fewer than three common images (two
    centres align exactly).
    """

    rotation_median_deg: float | None = Field(description="Over the common images, degrees.")
    rotation_mean_deg: float | None = Field(description="Over the common images, degrees.")
    centre_median: float | None = Field(description="Distance of the centres, in the truth's unit.")
    centre_mean: float | None = Field(description="In the truth's unit.")
    centre_relative_median: float | None = Field(description="`centre_median` over `radius`.")
    radius: float | None = Field(
        description="Root mean square distance of the true common centres from their mean."
    )
    scale: float | None = Field(description="Truth units in one unit of the estimate.")
    auc: dict[float, float] | None = Field(
        description="Threshold in degrees to the area, in 0..1, under the recall curve of the "
        "relative pose errors of all pairs of true images, up to the threshold; null for fewer "
        "than two images."
    )
    num_common: int = Field(description="Number of images in the estimate and the truth.")
    num_truth: int = Field(description="Number of images in the truth.")


def pose_error(estimated: Reconstruction, truth: Reconstruction) -> PoseError:
    """Compare the poses of images with equal names, or equal names without suffix (which changes
    when RAW files are developed).

    Images of the truth that the estimate lacks count as failures in the AUC, and in
    ``num_common`` against ``num_truth``; the other figures are over the common ones.

    The alignment is that of ``align_poses``.
    """
    posed, true = estimated.by_name(), truth.by_name()
    names = sorted(true)
    index = NameIndex(posed)
    matches = {name: index.find(name) for name in names}
    found = {name: posed[match] for name, match in matches.items() if match is not None}
    common = [name for name in names if name in found]
    auc = _relative_pose_auc(found, true, names)
    if not common:
        return PoseError(
            rotation_median_deg=None,
            rotation_mean_deg=None,
            centre_median=None,
            centre_mean=None,
            centre_relative_median=None,
            radius=None,
            scale=None,
            auc=auc,
            num_common=0,
            num_truth=len(names),
        )

    r_found = np.stack([found[n].rotation for n in common])
    r_true = np.stack([true[n].rotation for n in common])
    c_found = np.stack([found[n].centre for n in common])
    c_true = np.stack([true[n].centre for n in common])
    radius = float(np.sqrt(((c_true - c_true.mean(0)) ** 2).sum(1).mean()))
    aligned = align_poses(r_found, c_found, r_true, c_true)
    rotations = _angle(r_found @ aligned.rotation.T, r_true)
    centres = np.linalg.norm(aligned(c_found) - c_true, axis=1)
    enough = len(common) >= 3
    median = float(np.median(centres))
    return PoseError(
        rotation_median_deg=float(np.median(rotations)),
        rotation_mean_deg=float(rotations.mean()),
        centre_median=median if enough else None,
        centre_mean=float(centres.mean()) if enough else None,
        centre_relative_median=median / radius if enough and radius > 0 else None,
        radius=radius,
        scale=aligned.scale,
        auc=auc,
        num_common=len(common),
        num_truth=len(names),
    )


def align_poses(r_source: Array, c_source: Array, r_target: Array, c_target: Array) -> Similarity:
    """The similarity of the worlds of two sets of poses of the same images.

    Its rotation is computed from the centres if they determine it, else (one or two images, or
    collinear centres) from the camera rotations.

    Args:
        r_source, r_target: (N, 3, 3) world-to-camera rotations.
        c_source, c_target: (N, 3) camera centres.
    """
    scale, rotation, shift = umeyama(c_source, c_target)
    if len(c_source) < 3 or min(map(_spread_dimensions, (c_source, c_target))) < 2:
        # R_target ~ R_source @ rotation.T for each image; their chordal mean.
        u, _, vt = np.linalg.svd(np.einsum("nij,nik->jk", r_target, r_source))
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        shift = c_target.mean(0) - scale * rotation @ c_source.mean(0)
    return Similarity(scale, rotation, shift)


def auc_of_errors(errors: Array, limit: float) -> float:
    """Area under the cumulative recall of ``errors`` from 0 to ``limit``, over ``limit``.

    By the trapezoid rule, as in the evaluation of SuperGlue and the Image Matching Challenge.
    Failures have an infinite error.
    """
    errors = np.sort(np.asarray(errors, np.float64))
    if len(errors) == 0:
        return 0.0
    recall = np.concatenate([[0.0], np.arange(1, len(errors) + 1) / len(errors)])
    errors = np.concatenate([[0.0], errors])
    last = int(np.searchsorted(errors, limit))
    x = np.concatenate([errors[:last], [limit]])
    y = np.concatenate([recall[:last], [recall[last - 1]]])
    return float(np.trapezoid(y, x) / limit)


def _relative_pose_auc(found: dict, true: dict, names: list[str]) -> dict[float, float] | None:
    """AUC over all pairs of true images; a pair's error is the larger of the angles between
    the relative rotations and between the directions of the relative translations."""
    if len(names) < 2:
        return None
    errors = []
    for i, first in enumerate(names):
        rest = [n for n in names[i + 1 :] if first in found and n in found]
        errors.extend([np.inf] * (len(names) - 1 - i - len(rest)))
        if not rest:
            continue
        estimated, expected = (_relative(poses, first, rest) for poses in (found, true))
        rotation = _angle(estimated[0], expected[0])
        direction = _direction_angle(estimated[1], expected[1])
        errors.extend(np.maximum(rotation, direction))
    return {limit: auc_of_errors(np.array(errors), limit) for limit in AUC_DEGREES}


def _relative(poses: dict, first: str, rest: list[str]) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) and translations (M, 3) from camera ``first`` to each of ``rest``."""
    rotations = np.stack([poses[n].rotation @ poses[first].rotation.T for n in rest])
    translations = np.stack([poses[n].translation for n in rest])
    return rotations, translations - rotations @ poses[first].translation


def _angle(first: Array, second: Array) -> Array:
    """Angles in degrees between two stacks of rotations. By atan2, which is accurate for small
    angles."""
    delta = first @ np.swapaxes(second, -1, -2)
    axis = np.stack(
        [
            delta[:, 2, 1] - delta[:, 1, 2],
            delta[:, 0, 2] - delta[:, 2, 0],
            delta[:, 1, 0] - delta[:, 0, 1],
        ],
        axis=-1,
    )
    sine, cosine = np.linalg.norm(axis, axis=-1), np.trace(delta, axis1=1, axis2=2) - 1
    return np.degrees(np.arctan2(sine, cosine))


def _direction_angle(first: Array, second: Array) -> Array:
    """Angles in degrees between estimated and true directions. A true translation of length zero
    has no direction and hence no error; an estimated one of length zero is a failure (180)."""
    lengths = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    angle = np.degrees(np.arctan2(sine, (first * second).sum(1)))
    angle = np.where(lengths[0] == 0, 180.0, angle)
    return np.where(lengths[1] == 0, 0.0, angle)


def _spread_dimensions(centres: Array) -> int:
    """Dimension of the affine hull of points: 0 a point, 1 a line, 2 a plane, 3."""
    values = np.linalg.svd(centres - centres.mean(0), compute_uv=False)
    return int((values > 1e-6 * max(float(values[0]), 1e-300)).sum()) if values[0] > 0 else 0
