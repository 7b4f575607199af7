"""The section of the page that shows the trained scene, turnable: what its viewer is given.

The viewer is ``viewer/viewer.js``; the page holds it as one script, built beforehand.
"""

from __future__ import annotations

import base64
import json
import math
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
# The view's box is [-1, 1]; points out to this many boxes are kept, in 16-bit integers.
_REACH = 4.0
_STEP = _REACH / 32767
# Radii of scenes that SPZ holds well: its sizes reach from e^-10 to e^5.9, its steps are 2^-20.
_SPZ_RADII = (0.1, 100.0)


def viewer_script() -> str:
    """The viewer's JavaScript; it runs once the section's elements are there."""
    return _VIEWER.read_text("utf-8")


def space_section(data: ReportData, room: int) -> str:
    """HTML of the section.

    Args:
        room: bytes that the Gaussians may take in the page.
    """
    data = sized_for_spz(data)
    scene = data.trained
    if scene is None:
        return '<p class="hint">There is no trained scene.</p>'
    centres = np.array([view.centre for view in scene.views]).reshape(-1, 3)
    packed = fit(scene.gaussians, centres, room * 3 // 4)  # base64 makes 4 bytes of 3
    names = "".join(
        f'<option value="{i}">{escape(view.name)}{" (held out)" if view.is_test else ""}</option>'
        for i, view in enumerate(scene.views)
    )
    test = sum(view.is_test for view in scene.views)
    return (
        '<p class="hint">Drag to turn; drag with the right button, or two fingers, to move; click '
        "the scene once to zoom with the wheel. A click on a camera looks through it. Keys: "
        "arrows, with Shift to move, + and \u2212.</p>"
        '<div id="space"><canvas tabindex="0" aria-label="the trained scene"></canvas>'
        '<output></output><p role="status">Loading the scene\u2026</p></div>'
        '<form id="space-tools"><fieldset disabled>'
        f'<label>View <select name="view"><option value="">from afar</option>{names}</select>'
        '</label><button type="button" name="previous" aria-label="previous view">\u2039</button>'
        '<button type="button" name="next" aria-label="next view">\u203a</button>'
        '<label><input type="checkbox" name="cameras" checked> Cameras</label>'
        '<span class="choice"><label><input type="radio" name="show" value="splats" checked>'
        'Gaussians</label><label><input type="radio" name="show" value="points">Sparse points'
        '</label></span><button type="button" name="full">Full screen</button></fieldset></form>'
        f'<div class="keys"><span>{_shown(scene, packed)}</span>'
        f'<span><i style="background: var(--train)"></i>{count(len(scene.views) - test)} training '
        f'cameras</span><span><i style="background: var(--test)"></i>{count(test)} held-out '
        f"cameras</span><span>{count(len(data.points_xyz))} sparse points</span></div>"
        f'<script type="application/json" id="space-data">{_json(viewer_data(data, scene))}'
        f'</script><script type="text/plain" id="splats">{_base64(packed.spz)}</script>'
    )


def sized_for_spz(data: ReportData) -> ReportData:
    """The same scene, of radius 1 where its own is none for SPZ."""
    scene = data.trained
    if scene is None:
        return data
    centres = np.array([view.centre for view in scene.views]).reshape(-1, 3)
    finite = np.isfinite(data.points_xyz).all(axis=1)
    _, radius = _robust_box(data.points_xyz[finite], centres)
    if _SPZ_RADII[0] <= radius <= _SPZ_RADII[1]:
        return data
    whole = scene.gaussians
    gaussians = replace(
        whole, means=whole.means / radius, log_scales=whole.log_scales - math.log(radius)
    )
    views = []
    for view in scene.views:
        pose = view.world_to_camera.copy()
        pose[:3, 3] /= radius
        views.append(replace(view, world_to_camera=pose))
    trained = replace(scene, gaussians=gaussians, views=views, near=scene.near / radius)
    return replace(data, trained=trained, points_xyz=data.points_xyz / radius)


def _shown(scene: TrainedScene, packed: Packed) -> str:
    """How many Gaussians there are, and what of them is in the page."""
    whole = scene.gaussians
    text = f"{count(len(whole))} Gaussians"
    left_out = []
    if packed.count < len(whole):
        left_out.append(f"the {count(packed.count)} most prominent")
    if packed.sh_degree < whole.sh_degree:
        left_out.append(f"SH of degree {packed.sh_degree} instead of {whole.sh_degree}")
    if left_out:
        text += f" (this page, to stay small, has {' with '.join(left_out)}; the exports are whole)"
    return text


def viewer_data(data: ReportData, scene: TrainedScene) -> dict[str, Any]:
    """What the viewer draws beside the Gaussians.

    The page's frame has y up, and its unit box holds the scene.

    Returns:
        ``frame``: 16 numbers, world to the page's frame, column by column; ``near`` (world unit),
        ``background`` (RGB in [0, 1]), ``antialias``: as in training; ``cameras``: pinholes in
        pixels, turned upright, with ``world_to_camera`` (3, 4) row by row; ``start``: index of
        the camera to start from, or null; ``points``: base64 of int16 (P, 3), little-endian, in
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
    """The view's pinhole, turned as EXIF says the photograph is to be looked at (a mirroring is
    left out), as the viewer reads it."""
    w, h, fx, fy, cx, cy = view.width, view.height, view.fx, view.fy, view.cx, view.cy
    pose = view.world_to_camera[:3]
    right, down, forward = pose
    match orientation:
        case 3 | 4:
            cx, cy = w - cx, h - cy
            pose = np.stack([-right, -down, forward])
        case 5 | 6:  # what is left is shown on top
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
    """The view of median quality, else the middle one."""
    names = [view.name for view in scene.views]
    for comparison in data.comparisons:
        if comparison.label == "median" and comparison.name in names:
            return names.index(comparison.name)
    return len(names) // 2 if names else None


def _robust_box(xyz: Array, centres: Array) -> tuple[Array, float]:
    """Middle and radius that hold most cameras and half the points, wherever the rest may be."""
    groups = [(values, share) for values, share in ((xyz, 50), (centres, 96)) if len(values)]
    if not groups:
        return np.zeros(3), 1.0
    middle = np.mean([np.median(values, axis=0) for values, _ in groups], axis=0)
    reach = [np.percentile(np.linalg.norm(v - middle, axis=1), share) for v, share in groups]
    radius = float(max(reach))
    return middle, radius if radius > 0 else 1.0


def upright_frame(rotations: Array) -> Array:
    """(3, 3) world to a frame whose y is up: what the cameras agree to be so, or, where they do
    not, as from the air, what is behind them."""
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
    """So that neighbours do not hide one another."""
    if len(centres) < 2:
        return 0.06
    from scipy.spatial import cKDTree

    nearest = cKDTree(centres).query(centres, k=2)[0][:, 1]
    return float(np.clip(0.6 * np.median(nearest), 0.015, 0.07))


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _json(value: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
