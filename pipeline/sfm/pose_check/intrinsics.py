"""Other readings of given intrinsics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from pipeline.geometry.cameras import Camera
from pipeline.sfm.pose_check.conventions import PoseSet, Reading

# Steps of focal lengths that are tried: finer ones for a single mistake.
_FACTORS = tuple(2.0 ** (k / 4) for k in range(-24, 25) if abs(k) > 1)
_COARSE_FACTORS = _FACTORS[1::2]


# Focal lengths of ordinary cameras, divided by the longer side: others are not proposed.
_ORDINARY = (0.25, 8.0)


def intrinsics(given: PoseSet, rank: int = 1, *, coarse: bool = False) -> list[Reading]:
    """Focal lengths and principal points of another image size, in another unit or exchanged."""
    if any(camera.is_spherical for camera in given.cameras):
        return []
    found = []

    def add(cause: str, fix: str, change: Callable[[Camera], Camera], extra: int = 0) -> None:
        changed = {id(camera): change(camera) for camera in given.cameras}
        cameras = tuple(changed[id(camera)] for camera in given.cameras)
        found.append(Reading(cause, fix, replace(given, cameras=cameras), rank + extra))

    first = given.cameras[0].pinhole[0]
    unit = "write the intrinsics of images of the photographs' size, in pixels"
    side = max(given.cameras[0].width, given.cameras[0].height)
    for factor in _COARSE_FACTORS if coarse else _FACTORS:
        if not _ORDINARY[0] < first * factor / side < _ORDINARY[1]:
            continue
        text = (
            f"the focal length looks like {_rounded(first * factor)} pixels, not {first:.4g}: that "
            "of another image size, in another unit or from another angle"
        )
        add(text, unit, partial(_scaled, factor=factor))
        add(
            f"{text}; the principal point looks like the image's centre",
            unit,
            partial(_scaled, factor=factor, centred=True),
            1,
        )
        text = f"the intrinsics look like those of images {_rounded(1 / factor)} times as large"
        add(text, unit, partial(_scaled, factor=factor, with_point=True))
    add(
        "the principal point looks like the image's centre, not "
        + ", ".join(f"{value:.4g}" for value in given.cameras[0].pinhole[2:]),
        "write the principal point in pixels from the upper left corner",
        _centred,
    )
    add(
        "cx and cy look exchanged",
        "exchange cx and cy",
        lambda c: _with_pinhole(c, c.pinhole[0], c.pinhole[1], c.pinhole[3], c.pinhole[2]),
    )
    return found


def _rounded(value: float) -> str:
    return f"{value:.2g}" if value < 100 else f"{round(value, -1):.0f}"


def _scaled(
    camera: Camera, factor: float, *, centred: bool = False, with_point: bool = False
) -> Camera:
    """The camera with another focal length, and with another principal point on request."""
    fx, fy, cx, cy = (_centred(camera) if centred else camera).pinhole
    point = (cx * factor, cy * factor) if with_point else (cx, cy)
    return _with_pinhole(camera, fx * factor, fy * factor, *point)


def _centred(camera: Camera) -> Camera:
    fx, fy = camera.pinhole[:2]
    return _with_pinhole(camera, fx, fy, camera.width / 2, camera.height / 2)


def _with_pinhole(camera: Camera, fx: float, fy: float, cx: float, cy: float) -> Camera:
    params = camera.params.copy()
    one = camera.intrinsics_names[0] == "f"
    params[: 3 if one else 4] = (fx, cx, cy) if one else (fx, fy, cx, cy)
    return replace(camera, params=params)
