"""A smooth camera path through a scene, near where the photographs were taken."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.runtime.json_file import JsonFile, JsonObject, Matrix4
from pipeline.scene.views import View

Array = NDArray[np.float64]

FRAMES = 90
FPS = 30
#: Size of a frame over that of the views.
SCALE = 0.5
#: Cameras surround the subject if no gap in azimuth is wider than this, degrees.
_CLOSED_GAP = 120.0
#: Otherwise the path swings over this share of the cameras' range of azimuths...
_SWING_SHARE = 0.8
#: ...and over at least this many degrees.
_MIN_SWING = 6.0


class PathFile(JsonFile, JsonObject):
    """The camera path of the video: one pinhole camera, a pose for each frame."""

    file_name: ClassVar[str] = "path.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    convention: str = Field(description="Of the poses; sentences for people.")
    fps: int = Field(gt=0, description="Frames per second.")
    width: int = Field(gt=0, description="Of a frame, pixels.")
    height: int = Field(gt=0, description="Of a frame, pixels.")
    fx: float = Field(description="Focal length along x, pixels.")
    fy: float = Field(description="Focal length along y, pixels.")
    cx: float = Field(description="Principal point, pixels.")
    cy: float = Field(description="Principal point, pixels.")
    world_to_camera: tuple[Matrix4, ...] = Field(
        description="4 x 4 by rows, of each frame; unit and frame of the scene."
    )


def camera_path(views: Sequence[View], depth: float, up: Array) -> list[View]:
    """``FRAMES`` cameras on a closed smooth path, at ``SCALE`` of the views' size.

    If the views look at a common subject, the path goes around it, at the distance and height of
    the nearby cameras: a full circle if the cameras surround it, else back and forth. If not (a
    room from inside, a walk), the path goes through the views in the order of their names.

    Args:
        views: At least one view.
        depth: The typical distance of the scene from the cameras, world units.
        up: (3,) unit vector, up in the world.
    """
    centres = np.stack([view.centre for view in views])
    forward = np.stack([view.world_to_camera[2, :3] for view in views])
    focus = _focus(centres, forward, depth)
    to_focus = focus - centres
    to_focus /= np.maximum(np.linalg.norm(to_focus, axis=1, keepdims=True), 1e-12)
    if float(np.median((to_focus * forward).sum(axis=1))) > np.cos(np.radians(30)):
        positions = _around(centres - focus, up) + focus
        ahead = focus - positions
    else:
        positions, ahead = _smooth(centres), _smooth(forward)
    frame = _frame(views)
    return [
        replace(frame, name=f"{i:04d}", world_to_camera=_look_along(p, d, up))
        for i, (p, d) in enumerate(zip(positions, ahead, strict=True))
    ]


def describe_path(path: Sequence[View]) -> PathFile:
    """The content of ``path.json``."""
    first = path[0]
    return PathFile(
        convention="world to camera, 4x4 by rows; x right, y down, z forward; pixel centres at "
        "half integers; unit and frame of sparse/0",
        fps=FPS,
        **{name: getattr(first, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        world_to_camera=tuple(view.world_to_camera.tolist() for view in path),
    )


def _focus(centres: Array, forward: Array, depth: float) -> Array:
    """The point nearest to all optical axes, with a weak prior at the typical depth, which decides
    if the axes are parallel."""
    expected = (centres + depth * forward).mean(axis=0)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    system = across.mean(axis=0) + 0.05 * np.eye(3)
    right = (across * centres[:, None, :]).sum(axis=2).mean(axis=0) + 0.05 * expected
    return np.asarray(np.linalg.solve(system, right))


def _around(offsets: Array, up: Array) -> Array:
    """(FRAMES, 3) positions around the origin. In cylindrical coordinates about ``up``, distance
    and height are smooth functions of the azimuth, fitted to the cameras."""
    side, front = _horizontal_axes(up, offsets)
    azimuth = np.arctan2(offsets @ front, offsets @ side)
    height = offsets @ up
    radius = np.hypot(offsets @ side, offsets @ front)
    order = np.sort(azimuth)
    gaps = np.diff(np.append(order, order[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    phase = 2 * np.pi * np.arange(FRAMES) / FRAMES
    if gaps[widest] < np.radians(_CLOSED_GAP):
        angles, local = phase + order[0], azimuth
        terms = [np.ones_like, np.cos, np.sin]
    else:
        span = 2 * np.pi - gaps[widest]
        middle = order[(widest + 1) % len(order)] + span / 2
        swing = max(_SWING_SHARE * span, np.radians(_MIN_SWING)) / 2
        local = (azimuth - middle + np.pi) % (2 * np.pi) - np.pi
        angles = swing * np.sin(phase)
        terms = [np.ones_like, lambda a: a, lambda a: a * a]
    fitted = [_fit(terms, local, values, angles) for values in (radius, height)]
    if gaps[widest] >= np.radians(_CLOSED_GAP):
        angles = angles + middle
    flat = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * front
    return np.asarray(fitted[0][:, None] * flat + fitted[1][:, None] * up)


def _fit(terms: list[Any], at: Array, values: Array, query: Array) -> Array:
    """Ridge regression of ``values`` on the terms, evaluated at ``query`` and clipped to the 10th
    to 90th percentile of the values."""
    table = np.stack([term(at) for term in terms], axis=1)
    mean = values.mean()
    # The ridge avoids extreme curves for few cameras, or cameras in one place.
    ridge = 0.1 * np.eye(len(terms))
    weights = np.linalg.solve(table.T @ table + ridge, table.T @ (values - mean))
    found = mean + np.stack([term(query) for term in terms], axis=1) @ weights
    return np.asarray(np.clip(found, *np.percentile(values, [10, 90])))


def _horizontal_axes(up: Array, offsets: Array) -> tuple[Array, Array]:
    """Two unit vectors orthogonal to ``up``; the first towards the mean of the cameras, unless that
    is the origin."""
    for guess in (offsets.mean(axis=0), *np.eye(3)):
        side = guess - (guess @ up) * up
        if np.linalg.norm(side) > 1e-3 * (1e-12 + np.linalg.norm(guess)):
            side = side / np.linalg.norm(side)
            return side, np.cross(up, side)
    raise ValueError("up must be a unit vector")


def _smooth(values: Array) -> Array:
    """(FRAMES, 3) positions along the polygon ``values``, back and forth, smoothed by Gaussian."""
    there_and_back = np.concatenate([values, values[-2:0:-1]]) if len(values) > 2 else values
    count = len(there_and_back)
    place = np.arange(FRAMES) * count / FRAMES
    apart = np.abs(place[:, None] - np.arange(count))
    apart = np.minimum(apart, count - apart)
    # Wide enough to remove hand shake, and never narrower than the spacing of the frames.
    weight = np.exp(-0.5 * (apart / max(1.5, count / FRAMES)) ** 2)
    return np.asarray(weight @ there_and_back / weight.sum(axis=1, keepdims=True))


def _look_along(position: Array, ahead: Array, up: Array) -> Array:
    """(4, 4) world to camera."""
    z = ahead / np.linalg.norm(ahead)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(z, np.roll(up, 1))
    x = x / np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _frame(views: Sequence[View]) -> View:
    """A view of the most common size at ``SCALE``, with the median focal length, even sides (video
    encoders require them) and a centred principal point."""
    size = Counter((view.width, view.height) for view in views).most_common(1)[0][0]
    alike = [view for view in views if (view.width, view.height) == size]
    width, height = (max(2, 2 * round(side * SCALE / 2)) for side in size)
    focal = float(np.median([view.fx / view.width for view in alike])) * width
    return replace(
        alike[0],
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        is_test=True,
    )
