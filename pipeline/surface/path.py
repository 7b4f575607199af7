"""Smooth camera paths through a scene, near where the photographs were taken."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline
from scipy.ndimage import gaussian_filter1d

from pipeline.config.video import VideoExport
from pipeline.io.camera_paths import CameraPath, PathFile, read_camera_path
from pipeline.runtime.errors import UserError
from pipeline.runtime.suggest import did_you_mean, nearest
from pipeline.scene.views import View

Array = NDArray[np.float64]

#: Cameras surround the subject if no gap in azimuth is wider than this, degrees.
_CLOSED_GAP = 75.0
#: Otherwise the orbit swings over this share of the cameras' range of azimuths...
_SWING_SHARE = 0.8
#: ...and over at least this many degrees.
_MIN_SWING = 6.0
#: The most control points of a path through the cameras per second: more show how a hand shakes.
_CONTROLS_PER_SECOND = 2.0
#: Number of samples between control points, from which the speed along the path is computed.
_SAMPLES = 32
#: The suffix of images that a stage wrote anew.
_WRITTEN = ".png"


@dataclass(frozen=True)
class VideoPath:
    """The cameras of a video.

    Attributes:
        views: The camera of each frame.
        fps: Frames per second.
        words: A few words about the path.
    """

    views: list[View]
    fps: int
    words: str

    @property
    def seconds(self) -> float:
        """The duration."""
        return len(self.views) / self.fps


def camera_path(
    views: Sequence[View], depth: float, up: Array, video: VideoExport, origin: Array
) -> VideoPath:
    """The camera of each frame.

    An orbit goes around the subject, at the distance and height of the nearby cameras: a full
    circle if the cameras surround it, else back and forth. Another path goes through the views in
    the order of their names, at constant speed. With the path "auto", it is an orbit if most views
    look at a common subject, and not if they look outwards or along a way. Chosen photographs are
    met exactly. A file has the camera of each frame.

    Args:
        views: At least one view.
        depth: The typical distance of the scene from the cameras, world units.
        up: (3,) unit vector, up in the world.
        origin: (3,) the origin of the views' world in that of the exported cameras.

    Raises:
        UserError: A chosen photograph is no view, or the file cannot be read.
    """
    count, frame = video.num_frames, _frame(views, video.long_side_px)
    if isinstance(video.path, tuple):
        positions, ahead = _through_chosen(views, video.path, depth, count)
        words = f"through the cameras of {len(video.path)} chosen photographs"
    elif video.path_file is not None:
        return _of_file(read_camera_path(video.path_file), frame, video, origin)
    else:
        positions, ahead, words = _found_path(views, depth, up, video)
    path = [
        replace(frame, name=f"{i:04d}", world_to_camera=_look_along(p, d, up))
        for i, (p, d) in enumerate(zip(positions, ahead, strict=True))
    ]
    return VideoPath(path, video.fps, words)


def _found_path(
    views: Sequence[View], depth: float, up: Array, video: VideoExport
) -> tuple[Array, Array, str]:
    """(N, 3) positions and directions of an orbit or of a path near all cameras, and its words."""
    centres = np.stack([view.centre for view in views])
    forward = np.stack([view.world_to_camera[2, :3] for view in views])
    focus = _focus(centres, forward, depth)
    common = float(np.median((_unit(focus - centres) * forward).sum(axis=1))) > np.cos(
        np.radians(30)
    )
    if video.path == "orbit" or (video.path == "auto" and common):
        offsets, words = _around(centres - focus, up, video.num_frames)
        return offsets + focus, -offsets, words
    controls = round(video.seconds * _CONTROLS_PER_SECOND)
    positions, ahead = _through(centres, forward, depth, controls, video.num_frames)
    return positions, ahead, "through the cameras in the order of their names"


def _through_chosen(
    views: Sequence[View], names: Sequence[str], depth: float, count: int
) -> tuple[Array, Array]:
    """(count, 3) positions and directions on a cubic spline that meets the chosen cameras, at
    constant speed; a loop if the first is also the last."""
    by_name = {view.name: view for view in views}
    chosen = [_view_of(name, by_name) for name in names]
    centres = np.stack([view.centre for view in chosen])
    forward = np.stack([view.world_to_camera[2, :3] for view in chosen])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1) / depth
    steps += np.linalg.norm(np.diff(forward, axis=0), axis=1)
    if not (steps > 0).all():
        raise UserError(
            "export.video.path: two photographs that follow each other have the same camera",
            fix="leave out one of them",
        )
    loop = names[0] == names[-1] and len(names) > 3
    # Centripetal: no loops between cameras at uneven distances.
    knots = np.append(0.0, np.cumsum(np.sqrt(steps)))
    table = np.concatenate([centres, forward], axis=1)
    curve = CubicSpline(knots, table, bc_type="periodic" if loop else "natural")
    return _at_constant_speed(curve, knots, depth, count)


def _view_of(photograph: str, views: Mapping[str, View]) -> View:
    """The view of a photograph, whose name has another suffix if the view was written anew."""
    written = str(PurePosixPath(photograph).with_suffix(_WRITTEN))
    for name in (photograph, photograph + _WRITTEN, written):
        if name in views:
            return views[name]
    raise UserError(
        f"export.video.path: {photograph} has no pose{did_you_mean(nearest(photograph, views))}",
        fix="choose photographs with a pose, which the page of the result shows",
    )


def _of_file(path: CameraPath, frame: View, video: VideoExport, origin: Array) -> VideoPath:
    """The cameras of a file, at the size and rate of the file, or else those of the options."""
    if path.size is not None:
        largest = max(path.size)
        scale = 1.0 if video.long_side_px is None else video.long_side_px / largest
        width, height = _even(path.size, scale)
    else:
        width, height = frame.width, frame.height
    poses = path.world_to_camera.copy()
    if path.world == "cameras":
        poses[:, :3, 3] += np.einsum("nij,j->ni", poses[:, :3, :3], origin)
    frame = replace(frame, width=width, height=height, cx=width / 2, cy=height / 2)
    views = [
        replace(frame, name=f"{i:04d}", fx=f * height, fy=f * height, world_to_camera=pose)
        for i, (f, pose) in enumerate(zip(path.focal, poses, strict=True))
    ]
    words = f"along the {len(views)} cameras of {video.path} ({path.label})"
    return VideoPath(views, path.fps or video.fps, words)


def describe_path(path: VideoPath) -> PathFile:
    """The content of ``path.json``."""
    first = path.views[0]
    factors = tuple(view.fy / first.fy for view in path.views)
    return PathFile(
        convention="world to camera, 4x4 by rows; x right, y down, z forward; pixel centres at "
        "half integers; unit and frame of the exported Gaussians (frame.json)",
        fps=path.fps,
        **{name: getattr(first, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        focal_factors=None if set(factors) == {1.0} else factors,
        world_to_camera=tuple(view.world_to_camera.tolist() for view in path.views),
    )


def _focus(centres: Array, forward: Array, depth: float) -> Array:
    """The point nearest to all optical axes, and as near to what they show at the typical depth:
    axes of photographs from one side cross at the background as well as at the subject."""
    seen = centres + depth * forward
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    system = across.mean(axis=0) + np.eye(3)
    right = (across * centres[:, None, :]).sum(axis=2).mean(axis=0) + seen.mean(axis=0)
    return np.asarray(np.linalg.solve(system, right))


def _around(offsets: Array, up: Array, count: int) -> tuple[Array, str]:
    """(count, 3) positions around the origin, and a few words. In cylindrical coordinates about
    ``up``, distance and height are smooth functions of the azimuth, fitted to the cameras."""
    side, front = _horizontal_axes(up, offsets)
    azimuth = np.arctan2(offsets @ front, offsets @ side)
    height = offsets @ up
    radius = np.hypot(offsets @ side, offsets @ front)
    order = np.sort(azimuth)
    gaps = np.diff(np.append(order, order[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    phase = 2 * np.pi * np.arange(count) / count
    terms: list[Any]
    if gaps[widest] < np.radians(_CLOSED_GAP):
        middle, angles, local = 0.0, phase + order[0], azimuth
        terms = [np.ones_like, np.cos, np.sin]
        words = "a full circle around the subject"
    else:
        span = 2 * np.pi - gaps[widest]
        middle = order[(widest + 1) % len(order)] + span / 2
        swing = max(_SWING_SHARE * span, np.radians(_MIN_SWING))
        local = (azimuth - middle + np.pi) % (2 * np.pi) - np.pi
        angles = swing / 2 * np.sin(phase)
        terms = [np.ones_like, lambda a: a, lambda a: a * a]
        words = f"back and forth over {np.degrees(swing):.0f}° around the subject"
    radii, heights = (_fit(terms, local, values, angles) for values in (radius, height))
    angles = angles + middle
    flat = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * front
    return np.asarray(radii[:, None] * flat + heights[:, None] * up), words


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


def _through(
    centres: Array, forward: Array, depth: float, controls: int, count: int
) -> tuple[Array, Array]:
    """(count, 3) positions and directions on cubic B-splines near the cameras, from the first to
    the last one. The speed, of the picture's motion at ``depth``, is constant."""
    centres, forward = (_thinned(values, max(controls, 4)) for values in (centres, forward))
    degree = min(3, len(centres) - 1)
    inner = np.linspace(0.0, 1.0, len(centres) - degree + 1)
    knots = np.concatenate([np.zeros(degree), inner, np.ones(degree)])
    curve = BSpline(knots, np.concatenate([centres, forward], axis=1), degree)
    return _at_constant_speed(curve, np.linspace(0.0, 1.0, len(centres) + 1), depth, count)


def _at_constant_speed(
    curve: Callable[[Array], Array], knots: Array, depth: float, count: int
) -> tuple[Array, Array]:
    """(count, 3) positions and directions on a curve of both, from its first to its last knot; the
    picture's motion at ``depth`` is constant."""
    parts = np.arange(_SAMPLES * (len(knots) - 1) + 1) / _SAMPLES
    samples = np.interp(parts, np.arange(len(knots)), knots)
    position, ahead = np.split(curve(samples), 2, axis=1)
    moved = np.linalg.norm(np.diff(position, axis=0), axis=1) / depth
    turned = np.linalg.norm(np.diff(_unit(ahead), axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(moved + turned)])
    at = np.interp(np.linspace(0.0, way[-1], count), way, samples)
    position, ahead = np.split(curve(at), 2, axis=1)
    return position, _unit(ahead)


def _thinned(values: Array, count: int) -> Array:
    """At most ``count`` rows, evenly spaced in a smoothed copy of more of them."""
    if len(values) <= count:
        return values
    smoothed = gaussian_filter1d(values, 0.5 * len(values) / count, axis=0, mode="nearest")
    places = np.linspace(0, len(values) - 1, count)
    rows = np.arange(len(values))
    return np.stack([np.interp(places, rows, column) for column in smoothed.T], axis=1)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


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


def _frame(views: Sequence[View], long_side: int | None) -> View:
    """A view of the most common size, or with this longer side, with the median focal length, even
    sides (video encoders require them) and a centred principal point."""
    size = Counter((view.width, view.height) for view in views).most_common(1)[0][0]
    alike = [view for view in views if (view.width, view.height) == size]
    scale = 1.0 if long_side is None else long_side / max(size)
    width, height = _even(size, scale)
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
        crop=None,
    )


def _even(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """A scaled size, rounded down to even sides: no frame is larger than asked for."""
    width, height = (max(2, 2 * int(side * scale / 2 + 1e-9)) for side in size)
    return width, height
