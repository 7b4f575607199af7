"""The section of the page that shows the trained scene, turnable: what its viewer is given.

The viewer is ``viewer/viewer.js``; the page holds it as one script, built beforehand.
"""

from __future__ import annotations

import base64
import math
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from numpy.typing import NDArray

from pipeline.export.selection import subject_box
from pipeline.reporting.data import SceneResults, TrainedScene
from pipeline.reporting.depths import COLUMNS, DEPTH_RATIO, ROWS, coarse_depths, depth_codes
from pipeline.reporting.fit import MAX_GAUSSIANS, Packed, encoded, fit
from pipeline.reporting.pictures import Embedded, embedded, shrunk, upright
from pipeline.reporting.text import count
from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays

Array = NDArray[np.float64]

_VIEWER = Path(__file__).with_name("viewer") / "viewer.min.js"

#: The link from the page to a file with all Gaussians, which the stage ``report`` writes.
FULL = "report/scene.spz"

_MAX_POINTS = 25_000
# The longer side of the poster in pixels, and its JPEG quality.
_POSTER = (1000, 80)
# The scene's box is [-1, 1]; points within this multiple of it are stored as 16-bit integers.
_REACH = 4.0
_STEP = _REACH / 32767
# Steps of the box to crop with in the longest side of the subject, at least, and how far it can be
# moved from there, in multiples of that side.
_CROP_STEPS, _CROP_REACH = 200, 2.0
# Radii of scenes that SPZ represents well: scales from e^-10 to e^5.9, position steps of 2^-20.
_SPZ_RADII = (0.1, 100.0)


class ViewerContent(NamedTuple):
    """What the section of the viewer shows.

    Attributes:
        shown: A sentence on the Gaussians in the page.
        data: The viewer's input as JSON: ``viewer_data`` and ``full``.
        spz: The Gaussians as SPZ in base64.
        first: The merged Gaussians that are shown until those are decoded, likewise; None if there
            are none.
        poster: The render of the initial camera, shown until the Gaussians are; None if there is
            none.
        full: The link to a file with all Gaussians beside the page; None if the page has them.
    """

    shown: str
    data: Markup
    spz: str
    poster: Embedded | None = None
    full: str | None = None
    first: str | None = None


def viewer_script() -> Markup:
    """JavaScript of the viewer, to be placed after the elements of the section. The Gaussians that
    replace the first ones can follow it."""
    return Markup(_VIEWER.read_text("utf-8"))


def viewer_content(results: SceneResults, max_bytes: int) -> ViewerContent:
    """The content of the section.

    Args:
        max_bytes: The size limit of the Gaussians in the page.
    """
    results = sized_for_spz(results)
    centres = np.array([view.centre for view in results.trained.views]).reshape(-1, 3)
    # base64 makes 4 characters of 3 bytes.
    packed = fit(results.trained.gaussians, centres, max_bytes * 3 // 4)
    full = FULL if len(results.trained.gaussians) > MAX_GAUSSIANS else None
    return ViewerContent(
        shown=_shown(results.trained.gaussians, packed),
        data=htmlsafe_json_dumps(viewer_data(results) | {"full": full}, separators=(",", ":")),
        spz=_base64(packed.spz),
        poster=viewer_poster(results),
        full=full,
        first=None if packed.first is None else _base64(packed.first),
    )


def write_all(results: SceneResults, folder: Path) -> None:
    """Write all Gaussians to ``scene.spz`` in the folder ``report``, if the page has not all."""
    gaussians = sized_for_spz(results).trained.gaussians
    if len(gaussians) > MAX_GAUSSIANS:
        write_bytes(folder / PurePosixPath(FULL).name, encoded(gaussians))


def viewer_poster(results: SceneResults) -> Embedded | None:
    """The render of the initial camera."""
    start = _start(results)
    for view in results.comparisons:
        if start is not None and view.name == results.trained.views[start].name:
            side, quality = _POSTER
            return embedded(shrunk(upright(view.render, view.orientation), side), quality)
    return None


def sized_for_spz(results: SceneResults) -> SceneResults:
    """The same scene, scaled to radius 1 if SPZ cannot represent its radius."""
    scene, points = results.trained, results.points
    centres = np.array([view.centre for view in scene.views]).reshape(-1, 3)
    finite = np.isfinite(points.xyz).all(axis=1)
    _, radius = _robust_box(points.xyz[finite], centres)
    if _SPZ_RADII[0] <= radius <= _SPZ_RADII[1]:
        return results
    views = []
    for view in scene.views:
        pose = view.world_to_camera.copy()
        pose[:3, 3] /= radius
        views.append(replace(view, world_to_camera=pose))
    trained = replace(
        scene,
        gaussians=scene.gaussians.scaled(1 / radius),
        views=views,
        near=scene.near / radius,
        normalization=replace(scene.normalization, scale=scene.normalization.scale / radius),
    )
    return replace(results, trained=trained, points=replace(points, xyz=points.xyz / radius))


def _shown(whole: GaussianArrays, packed: Packed) -> str:
    """The number of Gaussians, and the part of them in the page."""
    text = f"{count(len(whole))} Gaussians"
    left_out = []
    if packed.count < len(whole):
        left_out.append(f"the {count(packed.count)} most prominent")
    if packed.sh_degree < whole.sh_degree:
        left_out.append(f"SH of degree {packed.sh_degree} instead of {whole.sh_degree}")
    if left_out:
        text += f" (to limit its size, this page has {' with '.join(left_out)})"
    return text


def viewer_data(results: SceneResults) -> dict[str, Any]:
    """Input of the viewer besides the Gaussians.

    The frame of the page has y up, as the world if its up direction is known; its unit box contains
    the scene.

    Returns:
        ``frame``: 16 numbers, world to the page's frame, column by column; ``near`` (world unit),
        ``background`` (RGB in [0, 1]), ``antialias``: as in training; ``cameras``: pinholes in
        pixels, in display orientation, with ``world_to_camera`` (3, 4) row by row; ``start``: index
        of the initial camera, or null; ``points``: base64 of int16 (P, 3), little-endian, in
        the page's frame in units of ``step``; ``colours``: base64 of uint8 (P, 3); ``size`` of a
        camera; ``unit``: ``name`` of the unit of the exported Gaussians, and ``scale``, the number
        of them in one unit of the world; ``crop``: as from ``_crop``; ``depths``: ``codes``, base64
        of the ``depth_codes`` of each camera, ``rows`` and ``columns``, and ``first`` (the page's
        unit) and ``ratio``, which decode them.
    """
    scene, points = results.trained, results.points
    cameras = [upright_camera(v, scene.orientations.get(v.name, 1)) for v in scene.views]
    centres = np.array([view.centre for view in scene.views]).reshape(-1, 3)
    poses = np.array([c["world_to_camera"] for c in cameras]).reshape(-1, 3, 4)
    finite = np.isfinite(points.xyz).all(axis=1)
    xyz, rgb = points.xyz[finite], points.rgb[finite]
    depths = coarse_depths(scene.gaussians, cameras, scene.near)
    middle, radius = _robust_box(xyz, centres)
    rotation = upright_frame(poses[:, :, :3], scene.up)
    frame = np.eye(4)
    frame[:3, :3] = rotation / radius
    frame[:3, 3] = -rotation @ middle / radius
    xyz = (xyz - middle) @ rotation.T / radius
    near = np.abs(xyz).max(axis=1, initial=0.0) <= _REACH
    xyz, rgb = xyz[near], rgb[near]
    if len(xyz) > _MAX_POINTS:
        chosen = np.random.default_rng(0).choice(len(xyz), _MAX_POINTS, replace=False)
        chosen.sort()
        xyz, rgb = xyz[chosen], rgb[chosen]
    return {
        "frame": frame.T.ravel().tolist(),
        "near": scene.near,
        "background": scene.background,
        "antialias": scene.antialias,
        "cameras": cameras,
        "start": _start(results),
        "points": _base64(np.rint(xyz / _STEP).astype("<i2").tobytes()),
        "step": _STEP,
        "colours": _base64(np.ascontiguousarray(rgb, np.uint8).tobytes()),
        "size": _camera_size(centres / radius),
        "unit": {
            "name": "m" if scene.is_metric else "scene units",
            "scale": 1 / scene.normalization.scale,
        },
        "crop": _crop(scene),
        "depths": {
            "rows": ROWS,
            "columns": COLUMNS,
            "first": scene.near / radius,
            "ratio": DEPTH_RATIO,
            "codes": _base64(depth_codes(depths, scene.near).tobytes()),
        },
    }


def upright_camera(view: View, orientation: int) -> dict[str, Any]:
    """The pinhole camera of a view, rotated by the EXIF orientation of its photograph (without
    mirroring), in the format of the viewer."""
    w, h, fx, fy, cx, cy = view.width, view.height, view.fx, view.fy, view.cx, view.cy
    pose = view.world_to_camera[:3]
    right, down, forward = pose
    match orientation:
        case 3 | 4:
            cx, cy = w - cx, h - cy
            pose = np.stack([-right, -down, forward])
        case 5 | 6:  # the left side is displayed on top
            w, h, fx, fy, cx, cy = h, w, fy, fx, h - cy, cx
            pose = np.stack([-down, right, forward])
        case 7 | 8:
            w, h, fx, fy, cx, cy = h, w, fy, fx, cy, w - cx
            pose = np.stack([down, -right, forward])
    pinhole = {"width": w, "height": h, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return {
        "name": view.name,
        "test": view.is_test,
        **pinhole,
        "world_to_camera": pose.ravel().tolist(),
    }


def _start(results: SceneResults) -> int | None:
    """Index of the compared view of median PSNR, else of the best, else of the middle view; None
    without views."""
    names = [view.name for view in results.trained.views]
    for label in ("median", "best"):
        for comparison in results.comparisons:
            if comparison.label == label and comparison.name in names:
                return names.index(comparison.name)
    return len(names) // 2 if names else None


def _robust_box(xyz: Array, centres: Array) -> tuple[Array, float]:
    """Centre and radius of a ball with most cameras and half the points, robust to outliers."""
    groups = [(values, share) for values, share in ((xyz, 50), (centres, 96)) if len(values)]
    if not groups:
        return np.zeros(3), 1.0
    middle = np.mean([np.median(values, axis=0) for values, _ in groups], axis=0)
    reach = [np.percentile(np.linalg.norm(v - middle, axis=1), share) for v, share in groups]
    radius = float(max(reach))
    return middle, radius if radius > 0 else 1.0


def _crop(scene: TrainedScene) -> dict[str, Any]:
    """The box to start cropping with, in the frame and unit of exported files.

    Returns:
        ``box``: the corners of the subject, as in ``export.region``; ``bounds``: those that it can
        have; ``step`` between positions.
    """
    try:
        box = np.array(subject_box(scene.gaussians, scene.views))
    except UserError:
        box = np.quantile(scene.gaussians.means, [0.05, 0.95], axis=0).ravel()
    low, high = box.reshape(2, 3) / scene.normalization.scale
    ends = np.quantile(scene.gaussians.means, [0.002, 0.998], axis=0) / scene.normalization.scale
    span = float((high - low).max()) or 1.0
    digits = -math.floor(math.log10(span / _CROP_STEPS))
    step = 10.0**-digits
    low, high = np.floor(low / step) * step, np.ceil(high / step) * step
    first = np.minimum(low, np.maximum(np.floor(ends[0] / step) * step, low - _CROP_REACH * span))
    last = np.maximum(high, np.minimum(np.ceil(ends[1] / step) * step, high + _CROP_REACH * span))
    return {
        "box": np.round([*low, *high], digits).tolist(),
        "bounds": np.round([*first, *last], digits).tolist(),
        "step": step,
    }


def upright_frame(rotations: Array, up: Array | None = None) -> Array:
    """(3, 3) rotation from the world to a frame with y up.

    Args:
        rotations: (C, 3, 3) world to camera.
        up: (3,) the world's unit vector upwards; None to estimate it from the cameras.
    """
    up = _up_of_cameras(rotations) if up is None else up
    other = np.eye(3)[np.argmin(np.abs(up))]
    z = np.cross(other, up)
    z /= np.linalg.norm(z)
    return np.stack([np.cross(up, z), up, z])


def _up_of_cameras(rotations: Array) -> Array:
    """(3,) mean up direction of the cameras or, if these cancel (aerial images), the mean direction
    opposite to their viewing direction."""
    for row in (1, 2):
        mean = -rotations[:, row].mean(axis=0) if len(rotations) else np.zeros(3)
        length = float(np.linalg.norm(mean))
        if length > 0.3:
            return np.asarray(mean / length)
    return np.array([0.0, -1.0, 0.0])


def _camera_size(centres: Array) -> float:
    """Size of a camera symbol that avoids overlaps."""
    if len(centres) < 2:
        return 0.06
    from scipy.spatial import cKDTree

    nearest = cKDTree(centres).query(centres, k=2)[0][:, 1]
    return float(np.clip(0.6 * np.median(nearest), 0.015, 0.07))


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
