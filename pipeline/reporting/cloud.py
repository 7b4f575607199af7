"""Cameras and sparse points, laid out upright and small enough to travel inside a page."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.reporting.data import ReportData

Array = NDArray[np.float64]

_MAX_POINTS = 25_000
# The view's box is [-1, 1]; points out to this many boxes are kept, in 16-bit integers.
_REACH = 4.0
_STEPS = 32767 / _REACH


def cloud(data: ReportData) -> dict[str, Any]:
    """What the page's script draws, all in a frame with z up whose unit box holds the scene.

    Returns:
        ``points``: base64 of int16 (P, 3), little-endian, in units of 1 / ``steps``; ``colours``:
        base64 of uint8 (P, 3); ``cameras``: [x, y, z, right, down, forward (three numbers each)];
        ``names``, ``test``; ``size`` of a camera; ``yaw`` (radians) to look from at first.
    """
    centres = np.asarray(data.camera_centres, np.float64).reshape(-1, 3)
    rotations = np.asarray(data.camera_rotations, np.float64).reshape(-1, 3, 3)
    finite = np.isfinite(data.points_xyz).all(axis=1)
    xyz, rgb = data.points_xyz[finite], data.points_rgb[finite]
    middle, radius = _robust_box(xyz, centres)
    upright = _upright(rotations)
    xyz = (xyz - middle) @ upright.T / radius
    near = np.abs(xyz).max(axis=1, initial=0.0) <= _REACH
    xyz, rgb = xyz[near], rgb[near]
    if len(xyz) > _MAX_POINTS:
        chosen = np.random.default_rng(0).choice(len(xyz), _MAX_POINTS, replace=False)
        chosen.sort()
        xyz, rgb = xyz[chosen], rgb[chosen]
    placed = (centres - middle) @ upright.T / radius
    axes = rotations @ upright.T
    cameras = np.concatenate([placed, axes.reshape(-1, 9)], axis=1)
    forward = axes[:, 2].sum(axis=0)
    return {
        "points": _base64(np.rint(xyz * _STEPS).astype("<i2")),
        "steps": _STEPS,
        "colours": _base64(np.ascontiguousarray(rgb, np.uint8)),
        "cameras": [[round(float(v), 4) for v in row] for row in cameras],
        "names": [str(name) for name in data.camera_names],
        "test": [bool(test) for test in data.camera_is_test],
        "size": round(_camera_size(placed), 4),
        "yaw": round(float(np.arctan2(forward[1], forward[0])), 4) if len(axes) else 0.0,
    }


def _robust_box(xyz: Array, centres: Array) -> tuple[Array, float]:
    """Middle and radius that hold most cameras and half the points, wherever the rest may be."""
    groups = [(values, share) for values, share in ((xyz, 50), (centres, 96)) if len(values)]
    if not groups:
        return np.zeros(3), 1.0
    middle = np.mean([np.median(values, axis=0) for values, _ in groups], axis=0)
    reach = [np.percentile(np.linalg.norm(v - middle, axis=1), share) for v, share in groups]
    radius = float(max(reach))
    return middle, radius if radius > 0 else 1.0


def _upright(rotations: Array) -> Array:
    """(3, 3) world to a frame whose z is what the cameras agree to be up."""
    down = rotations[:, 1].sum(axis=0) if len(rotations) else np.zeros(3)
    length = float(np.linalg.norm(down))
    up = -down / length if length > 1e-6 else np.array([0.0, -1.0, 0.0])
    other = np.eye(3)[np.argmin(np.abs(up))]
    x = np.cross(other, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _camera_size(centres: Array) -> float:
    """So that neighbours do not hide one another."""
    if len(centres) < 2:
        return 0.06
    from scipy.spatial import cKDTree

    nearest = cKDTree(centres).query(centres, k=2)[0][:, 1]
    return float(np.clip(0.6 * np.median(nearest), 0.015, 0.07))


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(values.tobytes()).decode()
