"""The section of the page that shows the trained scene, turnable: what its viewer is given.

The viewer is ``viewer/viewer.js``; the page holds it as one script, built beforehand.
"""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.reporting.data import ReportData, TrainedScene
from pipeline.reporting.fit import Packed, fit
from pipeline.reporting.text import count, escape
from pipeline.scene.views import View

Array = NDArray[np.float64]

_VIEWER = Path(__file__).with_name("viewer") / "viewer.min.js"

_MAX_POINTS = 25_000
# The scene's box is [-1, 1]; points within this multiple of it are stored as 16-bit integers.
_REACH = 4.0
_STEP = _REACH / 32767
# Radii of scenes that SPZ represents well: scales from e^-10 to e^5.9, position steps of 2^-20.
_SPZ_RADII = (0.1, 100.0)


def viewer_script() -> str:
    """JavaScript of the viewer, to be placed after the elements of the section."""
    return _VIEWER.read_text("utf-8")


def space_section(data: ReportData, max_bytes: int) -> str:
    """HTML of the section.

    Args:
        max_bytes: size limit of the Gaussians in the page.
    """
    data = sized_for_spz(data)
    scene = data.trained
    if scene is None:
        return '<p class="hint">There is no trained scene.</p>'
    centres = np.array([view.centre for view in scene.views]).reshape(-1, 3)
    packed = fit(scene.gaussians, centres, max_bytes * 3 // 4)  # base64 makes 4 bytes of 3
    names = "".join(
        f'<option value="{i}">{escape(view.name)}{" (test view)" if view.is_test else ""}</option>'
        for i, view in enumerate(scene.views)
    )
    test = sum(view.is_test for view in scene.views)
    return (
        '<p class="hint">Drag to rotate; drag with the right button or two fingers to pan; click '
        "the scene once to zoom with the wheel. Click a camera to look through it. Keys: "
        "arrows, with Shift to pan, + and \u2212.</p>"
        '<div id="space"><canvas tabindex="0" aria-label="the trained scene"></canvas>'
        '<output></output><p role="status">Loading the scene\u2026</p></div>'
        '<form id="space-tools"><fieldset disabled>'
        f'<label>View <select name="view"><option value="">overview</option>{names}</select>'
        '</label><button type="button" name="previous" aria-label="previous view">\u2039</button>'
        '<button type="button" name="next" aria-label="next view">\u203a</button>'
        '<label><input type="checkbox" name="cameras" checked> Cameras</label>'
        '<span class="choice"><label><input type="radio" name="show" value="splats" checked>'
        'Gaussians</label><label><input type="radio" name="show" value="points">Sparse points'
        '</label></span><button type="button" name="full">Full screen</button></fieldset></form>'
        f'<div class="keys"><span>{_shown(scene, packed)}</span>'
        f'<span><i style="background: var(--train)"></i>{count(len(scene.views) - test)} training '
        f'cameras</span><span><i style="background: var(--test)"></i>{count(test)} test '
        f"cameras</span><span>{count(len(data.points_xyz))} sparse points</span></div>"
        f'<script type="application/json" id="space-data">{_json(viewer_data(data, scene))}'
        f'</script><script type="text/plain" id="splats">{_base64(packed.spz)}</script>'
    )


def sized_for_spz(data: ReportData) -> ReportData:
    """The same scene, scaled to radius 1 if SPZ cannot represent its radius."""
    scene = data.trained
    if scene is None:
        return data
    centres = np.array([view.centre for view in scene.views]).reshape(-1, 3)
    finite = np.isfinite(data.points_xyz).all(axis=1)
    _, radius = _robust_box(data.points_xyz[finite], centres)
    if _SPZ_RADII[0] <= radius <= _SPZ_RADII[1]:
        return data
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
    )
    return replace(data, trained=trained, points_xyz=data.points_xyz / radius)


def _shown(scene: TrainedScene, packed: Packed) -> str:
    """Text: the number of Gaussians, and the part of them in the page."""
    whole = scene.gaussians
    text = f"{count(len(whole))} Gaussians"
    left_out = []
    if packed.count < len(whole):
        left_out.append(f"the {count(packed.count)} most prominent")
    if packed.sh_degree < whole.sh_degree:
        left_out.append(f"SH of degree {packed.sh_degree} instead of {whole.sh_degree}")
    if left_out:
        text += f" (to limit its size, this page has {' with '.join(left_out)})"
    return text


def viewer_data(data: ReportData, scene: TrainedScene) -> dict[str, Any]:
    """Input of the viewer besides the Gaussians.

    The frame of the page has y up; its unit box contains the scene.

    Returns:
        ``frame``: 16 numbers, world to the page's frame, column by column; ``near`` (world unit),
        ``background`` (RGB in [0, 1]), ``antialias``: as in training; ``cameras``: pinholes in
        pixels, in display orientation, with ``world_to_camera`` (3, 4) row by row; ``start``: index
        of the initial camera, or null; ``points``: base64 of int16 (P, 3), little-endian, in
        the page's frame in units of ``step``; ``colours``: base64 of uint8 (P, 3); ``size`` of a
        camera.
    """
    cameras = [upright_camera(v, scene.orientations.get(v.name, 1)) for v in scene.views]
    centres = np.array([view.centre for view in scene.views]).reshape(-1, 3)
    poses = np.array([c["world_to_camera"] for c in cameras]).reshape(-1, 3, 4)
    finite = np.isfinite(data.points_xyz).all(axis=1)
    xyz, rgb = data.points_xyz[finite], data.points_rgb[finite]
    middle, radius = _robust_box(xyz, centres)
    rotation = upright_frame(poses[:, :, :3])
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
        "start": _start(data, scene),
        "points": _base64(np.rint(xyz / _STEP).astype("<i2").tobytes()),
        "step": _STEP,
        "colours": _base64(np.ascontiguousarray(rgb, np.uint8).tobytes()),
        "size": _camera_size(centres / radius),
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


def _start(data: ReportData, scene: TrainedScene) -> int | None:
    """Index of the view of median PSNR, else of the middle view; None without views."""
    names = [view.name for view in scene.views]
    for comparison in data.comparisons:
        if comparison.label == "median" and comparison.name in names:
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


def upright_frame(rotations: Array) -> Array:
    """(3, 3) rotation from the world to a frame with y up: the mean up direction of the cameras or,
    if these cancel (aerial images), the mean direction opposite to their viewing direction."""
    up = np.array([0.0, -1.0, 0.0])
    for row in (1, 2):
        mean = -rotations[:, row].mean(axis=0) if len(rotations) else np.zeros(3)
        length = float(np.linalg.norm(mean))
        if length > 0.3:
            up = mean / length
            break
    other = np.eye(3)[np.argmin(np.abs(up))]
    z = np.cross(other, up)
    z /= np.linalg.norm(z)
    return np.stack([np.cross(up, z), up, z])


def _camera_size(centres: Array) -> float:
    """Size of a camera symbol that avoids overlaps."""
    if len(centres) < 2:
        return 0.06
    from scipy.spatial import cKDTree

    nearest = cKDTree(centres).query(centres, k=2)[0][:, 1]
    return float(np.clip(0.6 * np.median(nearest), 0.015, 0.07))


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _json(value: Any) -> str:
    """JSON that is safe inside a script element."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
