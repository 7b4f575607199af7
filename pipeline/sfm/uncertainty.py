"""Uncertainty of poses and focal lengths: the covariance of the least squares problem of the last
bundle adjustment, with the variance of keypoints that its residuals show.

pycolmap's covariance differs in its last bits from run to run, is missing altogether if one
photograph is not determined, and frees the principal points of all cameras or of none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from pipeline.sfm.judge import MAX_FOCAL_OFF
from pipeline.sfm.keypoint_variance import (
    RELIABLE_RESIDUALS,
    keypoint_variance,
    loss_scale,
    median_error,
)
from pipeline.sfm.uncertainty_file import PoseUncertainty, Uncertainty

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Larger models have no uncertainty: the time of the inverse grows with the cube of their size.
MAX_PHOTOGRAPHS = 1000
#: Tracks are thinned to about this number of observations of each photograph.
OBSERVATIONS = 400
#: The position of a photograph is compared with those of this number of photographs.
NEIGHBOURS = 8
#: Views with a larger deviation, in medians, have no part in the similarity that poses are relative
#: to.
UNCERTAIN = 3.0
#: The rounding of EXIF's focal lengths.
EXIF_DEVIATION = 0.05
#: Damping of points and cameras, relative to their second derivatives. What nothing determines gets
#: a huge deviation.
POINT_DAMPING, DAMPING = 1e-9, 1e-11
#: Relative step of numerical derivatives.
STEP = 1e-6
#: Larger residuals, and derivatives by angles, are at the seam of a panorama.
MAX_RESIDUAL_PX, MAX_DERIVATIVE_PX = 100.0, 1e6
#: Results have this number of digits: the order of sums in BLAS does not show.
DIGITS = 3


@dataclass(frozen=True)
class _View:
    """An image and a sample of its observations.

    Attributes:
        camera: The id of the camera.
        rotation, centre: World to camera (3, 3), and the camera's position (3,).
        positions: (A, 2) all keypoints, as shares of the width and the height.
        residuals: (A, 2) their reprojection errors, pixels.
        points: (O,) the indices of the points of the sample.
        by_pose: (O, 2, 6) derivatives of the residuals by a rotation in the frame of the camera
            and by the centre in that of the world.
        by_point: (O, 2, 3) their derivatives by the point.
        by_camera: (O, 2, K) their derivatives by the free parameters of the camera, focal length
            first.
    """

    camera: int
    rotation: Floats
    centre: Floats
    positions: Floats
    residuals: Floats
    points: Ints
    by_pose: Floats
    by_point: Floats
    by_camera: Floats


def estimate_uncertainty(
    model: pycolmap.Reconstruction, exif: Mapping[int, float]
) -> Uncertainty | None:
    """The uncertainty of the poses and focal lengths of an adjusted model; None for fewer than two
    or more than ``MAX_PHOTOGRAPHS`` photographs.

    Free parameters are poses, points, focal lengths, distortions, and the principal points that are
    not the centres of the images. A focal length that agrees with EXIF is off by no more than the
    two differ, or EXIF's values are rounded by.

    Args:
        exif: Camera id -> focal length from EXIF, pixels.
    """
    images = [model.image(i) for i in sorted(model.reg_image_ids())]
    if not 2 <= len(images) <= MAX_PHOTOGRAPHS:
        return None
    views, radius, covariance, starts = _solved(model, images, exif)
    count = len(views)
    poses = covariance[: 6 * count, : 6 * count].reshape(count, 6, count, 6)
    blocks = np.einsum("iaib->iab", poses)
    beside = _beside_neighbours(covariance, views)
    rotations, centres, relative = (
        np.sqrt(np.maximum(np.linalg.eigvalsh(each)[:, -1], 0.0))
        for each in (blocks[:, :3, :3], blocks[:, 3:, 3:], beside)
    )
    shares = relative / np.maximum(_baselines(views), 1e-12)
    names = {image.name: row for row, image in enumerate(images)}
    return Uncertainty(
        photographs={
            name: PoseUncertainty(
                centre=_rounded(centres[row] * radius),
                baseline_share=_rounded(shares[row]),
                direction_deg=_rounded(np.degrees(rotations[row])),
            )
            for name, row in sorted(names.items())
        },
        focal_percent={
            camera_id: _rounded(
                100
                * np.sqrt(covariance[start, start])
                / model.camera(camera_id).mean_focal_length()
            )
            for camera_id, start in starts.items()
            if not model.camera(camera_id).is_spherical()
        },
    )


def camera_deviations(model: pycolmap.Reconstruction) -> dict[int, dict[int, float]]:
    """Camera id -> the standard deviations of its free parameters by their indices."""
    images = [model.image(i) for i in sorted(model.reg_image_ids())]
    _, _, covariance, starts = _solved(model, images, {})
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return {
        camera_id: {
            index: float(deviations[start + row])
            for row, index in enumerate(_free_parameters(model.camera(camera_id)))
        }
        for camera_id, start in starts.items()
    }


def _solved(
    model: pycolmap.Reconstruction, images: list[pycolmap.Image], exif: Mapping[int, float]
) -> tuple[list[_View], float, Floats, dict[int, int]]:
    """The views, the unit of their frame, and the covariance and first columns of ``_covariance``
    for the keypoints of the model."""
    views, weights, radius = _read(model, images)
    free = {view.camera: view.by_camera.shape[2] for view in views}
    residuals = [view.residuals for view in views]
    parameters = 6 * len(views) - 7 + sum(free.values()) + 3 * len(weights)
    variance = keypoint_variance(
        residuals,
        [view.positions for view in views],
        loss_px=loss_scale(model),
        parameters=min(parameters / max(2 * sum(map(len, residuals)), 1), 0.9),
    )
    priors = {
        camera_id: variance / deviation**2
        for camera_id in free
        if (deviation := _prior_deviation(model.camera(camera_id), exif.get(camera_id)))
    }
    covariance, starts = _covariance(views, weights, free, priors)
    return views, radius, variance * covariance, starts


def _prior_deviation(camera: pycolmap.Camera, exif: float | None) -> float | None:
    """The standard deviation of a focal length by EXIF's, pixels; None where they differ much."""
    if exif is None or camera.is_spherical():
        return None
    focal = camera.mean_focal_length()
    off = max(focal / exif, exif / focal) - 1
    return max(off, EXIF_DEVIATION) * exif if off <= MAX_FOCAL_OFF - 1 else None


def _read(
    model: pycolmap.Reconstruction, images: list[pycolmap.Image]
) -> tuple[list[_View], Floats, float]:
    """The views in a frame whose unit is the spread of the cameras, the number of points that each
    point of the sample stands for (0 beyond the sample), and that unit."""
    centres = np.stack([image.projection_center() for image in images])
    middle, radius = centres.mean(0), float(centres.std(0).max()) or 1.0
    largest = RELIABLE_RESIDUALS * median_error(model)
    found = {i: p.xyz for i, p in model.points3D.items() if p.error <= largest}
    ids = np.array(sorted(found), np.int64)
    xyz = np.array([found[i] for i in ids.tolist()]).reshape(-1, 3)
    observed = [
        [p for p in image.get_observation_points2D() if p.point3D_id in found] for image in images
    ]
    points = [np.searchsorted(ids, [p.point3D_id for p in seen]) for seen in observed]
    fewest = np.full(len(ids), np.inf)
    for seen_points in points:
        fewest[seen_points] = np.minimum(fewest[seen_points], len(seen_points))
    share = np.minimum(OBSERVATIONS / fewest, 1.0)
    # Multiples of the golden ratio spread evenly over 0 to 1.
    weights = np.where(ids * 0.6180339887498949 % 1 < share, 1 / share, 0.0)
    views = [
        _view(
            model.camera(image.camera_id),
            image.cam_from_world().rotation.matrix(),
            centre,
            (rows, (xyz[rows] - middle) / radius, np.array([p.xy for p in seen]).reshape(-1, 2)),
            weights,
        )
        for image, centre, rows, seen in zip(
            images, (centres - middle) / radius, points, observed, strict=True
        )
    ]
    return views, weights, radius


def _view(
    camera: pycolmap.Camera,
    rotation: Floats,
    centre: Floats,
    observed: tuple[Ints, Floats, Floats],
    weights: Floats,
) -> _View:
    """``observed``: the indices of the points, their positions, and the keypoints."""
    points, xyz, xy = observed
    local = (xyz - centre) @ rotation.T
    residuals = _project(camera, local) - xy
    kept = np.isfinite(residuals).all(1) & (np.abs(residuals).max(1) < MAX_RESIDUAL_PX)
    positions, residuals = xy[kept] / [camera.width, camera.height], residuals[kept]
    sample = kept & (weights[points] > 0)
    points, local = points[sample], local[sample]
    by_local, by_camera = _by_local(camera, local), _by_camera(camera, local)
    # A small rotation w adds w x X to the local point X.
    by_rotation, by_point = -np.cross(by_local, local[:, None, :]), by_local @ rotation
    by_pose = np.concatenate([by_rotation, -by_point], axis=2)
    good = np.isfinite(by_pose).all((1, 2)) & np.isfinite(by_camera).all((1, 2))
    good &= np.abs(by_rotation).max((1, 2), initial=0) < MAX_DERIVATIVE_PX
    return _View(
        camera.camera_id,
        rotation,
        centre,
        positions,
        residuals,
        points[good],
        by_pose[good],
        by_point[good],
        by_camera[good],
    )


def _project(camera: pycolmap.Camera, local: Floats) -> Floats:
    """(O, 2) pixels of (O, 3) points in the frame of the camera; NaN where there is none."""
    return np.asarray(camera.img_from_cam(local), np.float64).reshape(-1, 2)


def _free_parameters(camera: pycolmap.Camera) -> list[int]:
    """The indices of the parameters that the adjustment may have changed."""
    if camera.is_spherical():
        return []
    free = [*camera.focal_length_idxs(), *camera.extra_params_idxs()]
    centre = np.array([camera.principal_point_x, camera.principal_point_y])
    if not np.allclose(centre, [camera.width / 2, camera.height / 2], atol=1e-9):
        free += camera.principal_point_idxs()
    return free


def _by_camera(camera: pycolmap.Camera, local: Floats) -> Floats:
    """(O, 2, K) derivatives of the projection by the free parameters, focal length first."""
    free = _free_parameters(camera)
    sides = np.empty((2, len(free), len(local), 2))
    steps = np.array([STEP * max(abs(camera.params[index]), 1.0) for index in free])
    for side, sign in enumerate((1, -1)):
        for row, index in enumerate(free):
            changed = pycolmap.Camera(camera.todict())
            params = [float(value) for value in camera.params]
            params[index] += sign * steps[row]
            changed.params = params
            sides[side, row] = _project(changed, local)
    return ((sides[0] - sides[1]) / (2 * steps[:, None, None])).transpose(1, 2, 0)


def _by_local(camera: pycolmap.Camera, local: Floats) -> Floats:
    """(O, 2, 3) derivatives of the projection by the points."""
    steps = STEP * np.linalg.norm(local, axis=1, keepdims=True)
    sides = [
        (_project(camera, local + steps * axis) - _project(camera, local - steps * axis))
        / (2 * steps)
        for axis in np.eye(3)
    ]
    return np.stack(sides, axis=2)


def _covariance(
    views: list[_View], weights: Floats, free: dict[int, int], priors: dict[int, float]
) -> tuple[Floats, dict[int, int]]:
    """The covariance of poses (six columns for each view, in the free gauge) and of the cameras'
    parameters for keypoints of unit variance, and the first column of each camera.

    ``priors``: camera id -> the inverse variance of the focal length by itself.
    """
    columns, starts = 6 * len(views), dict[int, int]()
    for camera_id in sorted(free):
        starts[camera_id] = columns
        columns += free[camera_id]
    normal = _reduced_normal_equations(views, weights, starts, columns)
    diagonal = np.einsum("ii->i", normal)
    for camera_id, prior in priors.items():
        diagonal[starts[camera_id]] += prior
    gauge = np.zeros((columns, 7))
    gauge[: 6 * len(views)] = _gauge(views)
    # These directions change no residual. They get some information, which the free gauge removes.
    normal += np.diag(normal).mean() * gauge @ gauge.T
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.inv(normal / np.outer(scale, scale) + DAMPING * np.eye(columns))
    covariance = inverse / np.outer(scale, scale)
    poses = slice(0, 6 * len(views))
    covariance[poses, poses] = _in_free_gauge(covariance[poses, poses], views)
    return covariance, starts


def _gauge(views: list[_View]) -> Floats:
    """(6 N, 7) orthonormal changes of the poses by similarities of the world."""
    gauge = np.zeros((len(views), 6, 7))
    for row, view in enumerate(views):
        x, y, z = view.centre
        gauge[row, :3, :3] = -view.rotation
        gauge[row, 3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        gauge[row, 3:, 3] = view.centre
        gauge[row, 3:, 4:] = np.eye(3)
    return np.linalg.qr(gauge.reshape(-1, 7))[0]


def _in_free_gauge(covariance: Floats, views: list[_View]) -> Floats:
    """A covariance of poses (six columns for each view) relative to the similarity that fits the
    views best; views far less certain than the median have no part in it."""
    gauge, weights = _gauge(views), np.ones(6 * len(views))
    for _ in range(2):
        fit = np.linalg.pinv((gauge.T * weights) @ gauge) @ (gauge.T * weights)
        left = covariance - gauge @ (fit @ covariance)
        found = left - (left @ fit.T) @ gauge.T
        deviations = np.sqrt(np.abs(np.diag(found).reshape(-1, 6)[:, 3:].sum(1)))
        weights = np.repeat(deviations <= UNCERTAIN * np.median(deviations), 6).astype(np.float64)
    return found


def _beside_neighbours(covariance: Floats, views: list[_View]) -> Floats:
    """(N, 3, 3) covariances of the centres relative to the views that share the most points: the
    similarity that fits these views best is removed."""
    counts = [len(view.points) for view in views]
    row, point = np.repeat(np.arange(len(views)), counts), np.concatenate([v.points for v in views])
    seen = csr_matrix((np.ones(len(row)), (row, point)))
    shared = (seen @ seen.T).toarray()
    blocks = np.empty((len(views), 3, 3))
    for index in range(len(views)):
        shared[index, index] = np.inf
        near = np.argsort(-shared[index], kind="stable")[: NEIGHBOURS + 1]
        part = (6 * near[:, None] + np.arange(6)).ravel()
        relative = _in_free_gauge(covariance[np.ix_(part, part)], [views[i] for i in near])
        blocks[index] = relative[3:6, 3:6]
    return blocks


def _reduced_normal_equations(
    views: list[_View], weights: Floats, starts: dict[int, int], columns: int
) -> Floats:
    """(C, C) normal equations of poses and cameras, from which the points are eliminated."""
    used, point = np.unique(np.concatenate([v.points for v in views]), return_inverse=True)
    weight = weights[used][point]
    widest = max(view.by_camera.shape[2] for view in views)
    by, at = [], []
    for row, view in enumerate(views):
        count, free = view.by_camera.shape[0], view.by_camera.shape[2]
        unused = np.zeros((count, 2, widest - free))
        by.append(np.concatenate([view.by_pose, view.by_camera, unused], axis=2))
        index = np.zeros(6 + widest, np.int64)
        index[:6] = 6 * row + np.arange(6)
        index[6 : 6 + free] = starts[view.camera] + np.arange(free)
        at.append(np.broadcast_to(index, (count, 6 + widest)))
    by_camera, column = np.concatenate(by), np.concatenate(at)
    by_point = np.concatenate([view.by_point for view in views])
    blocks = np.swapaxes(by_point, 1, 2) @ by_point
    sums = [np.bincount(point, block, len(used)) for block in blocks.reshape(-1, 9).T]
    of_point = np.stack(sums, axis=1).reshape(-1, 3, 3)
    damping = POINT_DAMPING * np.trace(of_point, axis1=1, axis2=2) + 1e-300
    root = np.linalg.inv(np.linalg.cholesky(of_point + damping[:, None, None] * np.eye(3)))
    # Points are eliminated by the product of the mixed derivatives and the root of the inverse.
    mixed = np.swapaxes(by_camera, 1, 2) @ by_point @ np.swapaxes(root[point], 1, 2)
    single = _sparse(by_camera, column, 2 * np.arange(len(point)), 2 * len(point), columns, weight)
    joint = _sparse(np.swapaxes(mixed, 1, 2), column, 3 * point, 3 * len(used), columns, weight)
    return np.asarray((single.T @ single - joint.T @ joint).toarray())


def _sparse(
    values: Floats, column: Ints, row: Ints, rows: int, columns: int, weight: Floats
) -> csr_matrix:
    """Matrix of (O, R, C) blocks that start at ``row`` and have the columns ``column``, times the
    square roots of the weights; blocks of the same place are added."""
    height = values.shape[1]
    weighted = values * np.sqrt(weight)[:, None, None]
    at = np.broadcast_to(row[:, None, None] + np.arange(height)[:, None], values.shape)
    across = np.broadcast_to(column[:, None, :], values.shape)
    return csr_matrix((weighted.ravel(), (at.ravel(), across.ravel())), shape=(rows, columns))


def _baselines(views: list[_View]) -> Floats:
    """(N,) the median over the points of each view of the distance to the farthest view that
    observes the point."""
    image = np.repeat(np.arange(len(views)), [len(view.points) for view in views])
    point = np.concatenate([view.points for view in views])
    order = np.lexsort((image, point))
    centre = np.stack([view.centre for view in views])[image[order]]
    track, farthest = point[order], np.zeros(len(order))
    for apart in range(1, len(order)):
        same = np.flatnonzero(track[apart:] == track[:-apart])
        if not len(same):
            break
        distance = np.linalg.norm(centre[same + apart] - centre[same], axis=1)
        for side in (same, same + apart):
            farthest[side] = np.maximum(farthest[side], distance)
    of_image = np.zeros(len(order))
    of_image[order] = farthest
    ends = np.cumsum([len(view.points) for view in views])[:-1]
    return np.array([np.median(d) if len(d) else 0.0 for d in np.split(of_image, ends)])


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS - 1}e}")
