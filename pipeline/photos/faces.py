"""Splitting wide photographs into pinhole views: the faces of a cube around the camera.

A pinhole image of more than about 110 degrees is stretched at its border, and none holds 180.
Panoramas and wide fisheye photographs are therefore split into up to six views, each looking along
an axis of the camera and cropped to what the lens sees. Neighbours overlap by
``cube.OVERLAP_DEGREES``, so every ray of the photograph is in some view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.cube import REACH, ROTATIONS
from pipeline.geometry.rays import pixels, rays
from pipeline.photos.lens import Lens, mapped_lens

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# The largest field of view along a side of a photograph that becomes one pinhole view.
MAX_FIELD_DEGREES = 110.0
# The smallest side of a cropped face as a share of the whole face: narrower views are useless.
MIN_SIDE = 0.25
# A face is left out if a smaller share of the photograph's pixels is in no other face.
MIN_SHARE = 0.001
# The number of samples along the longer side of a photograph by which faces are chosen and cropped.
SAMPLES = 512
# The number of pixels by which a panorama is extended beyond its borders, for interpolation there.
PADDING = 4


@dataclass(frozen=True)
class WideCamera:
    """A camera and the part of its image that the lens fills.

    Attributes:
        camera: The camera at the photograph's size.
        radius: The radius of the image circle around the principal point in pixels; infinity if it
            covers the whole image.
        nadir: The angle in radians around the camera's downward axis within which rays are masked.
    """

    camera: Camera
    radius: float = np.inf
    nadir: float = 0.0

    def sees(self, xy: Floats) -> Bools:
        """(...) whether pixels (..., 2) are inside the image and its circle; False for NaN."""
        size = (self.camera.width, self.camera.height)
        inside = ((xy >= 0) & (xy <= size)).all(axis=-1)
        if np.isfinite(self.radius):
            inside &= np.hypot(*np.moveaxis(xy - self.camera.pinhole[2:], -1, 0)) <= self.radius
        return np.asarray(inside)

    def samples(self) -> Floats:
        """(N, 3) unit rays through a grid of pixels that the lens fills."""
        width, height = self.camera.width, self.camera.height
        step = max(max(width, height) / SAMPLES, 1.0)
        x, y = (np.arange(step / 2, side, step) for side in (width, height))
        xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        found = rays(self.camera, xy[self.sees(xy)])
        return found[np.isfinite(found).all(axis=1)]

    def field_degrees(self) -> tuple[float, float]:
        """The field of view along the width and the height, through the principal point."""
        if self.camera.is_spherical:
            return 360.0, 180.0
        cx, cy = self.camera.pinhole[2:]
        ends = ((0.0, cy), (self.camera.width, cy), (cx, 0.0), (cx, self.camera.height))
        angles = []
        for end in ends:
            line = np.linspace((cx, cy), end, SAMPLES + 1)
            seen = rays(self.camera, line[self.sees(line)])
            along = np.arccos(np.clip(seen[:, 2], -1, 1))
            angles.append(float(np.degrees(np.nanmax(along, initial=0.0))))
        return angles[0] + angles[1], angles[2] + angles[3]

    @property
    def is_split(self) -> bool:
        """Whether photographs become several views."""
        if self.camera.is_spherical:
            return True
        return "FISHEYE" in self.camera.model and max(self.field_degrees()) > MAX_FIELD_DEGREES


@dataclass(frozen=True)
class Face:
    """A pinhole view of a wide photograph.

    Attributes:
        name: The name of the direction: "front", "right", ...
        rotation: (3, 3) float64 rotation from the photograph's camera to the view's.
        camera: The PINHOLE camera, with the angular resolution of the photograph's centre.
    """

    name: str
    rotation: Floats
    camera: Camera

    def holds(self, directions: Floats) -> Bools:
        """(N,) whether rays (N, 3) of the photograph's camera are inside the view."""
        xy = pixels(self.camera, directions @ self.rotation.T)
        return np.asarray(((xy >= 0) & (xy <= (self.camera.width, self.camera.height))).all(axis=1))


def split(wide: WideCamera) -> list[Face]:
    """The views of a wide camera."""
    directions = wide.samples()
    inside = {name: _in_face(name, directions) for name in ROTATIONS}
    chosen = dict(inside)
    for name in reversed(ROTATIONS):
        others = [seen for other, seen in chosen.items() if other != name]
        alone = chosen[name] & ~np.any(others, axis=0) if others else chosen[name]
        if alone.sum() < MIN_SHARE * len(directions):
            del chosen[name]
    return [_face(wide, name, directions[seen]) for name, seen in chosen.items()]


def used_share(wide: WideCamera, faces: list[Face]) -> float:
    """The share of the photograph's pixels inside the image circle that are in some view."""
    directions = wide.samples()
    if not len(directions):
        return 0.0
    return float(np.any([face.holds(directions) for face in faces], axis=0).mean())


def face_lens(wide: WideCamera, face: Face, max_long_side: int) -> Lens:
    """The map of a view. For a panorama it refers to the picture extended by ``padded``."""

    def sample(points: Floats) -> tuple[Floats, Bools]:
        xy, valid = _sample(wide, face, points)
        offset = PADDING if wide.camera.is_spherical else 0
        return np.where(valid[..., None], xy, -1.0) + offset, valid

    return mapped_lens(face.camera, sample, max_long_side)


def depth_factor(wide: WideCamera, face: Face) -> Floats:
    """(height, width) factors from stored depths to depths along the view's axis, at the pixels of
    the view's camera. Stored depths of panoramas are distances, those of others are along the
    lens's axis. The factor is 0 where the lens looks sideways or backwards."""
    fx, fy, cx, cy = face.camera.pinhole
    x = (np.arange(face.camera.width) + 0.5 - cx) / fx
    y = (np.arange(face.camera.height) + 0.5 - cy) / fy
    local = _unit(np.stack(np.meshgrid(x, y), axis=-1))
    if wide.camera.is_spherical:
        return local[..., 2]
    ahead = (local @ face.rotation)[..., 2]
    return np.where(ahead > 0.05, local[..., 2] / np.maximum(ahead, 0.05), 0.0)


def padded(picture: NDArray) -> NDArray:
    """A panorama extended by ``PADDING`` pixels: by the other side at the left and right, and by
    the opposite meridian beyond the poles."""
    turned = np.roll(picture, picture.shape[1] // 2, axis=1)
    top, bottom = turned[:PADDING][::-1], turned[-PADDING:][::-1]
    tall = np.concatenate([top, picture, bottom], axis=0)
    return np.concatenate([tall[:, -PADDING:], tall, tall[:, :PADDING]], axis=1)


def _sample(wide: WideCamera, face: Face, points: Floats) -> tuple[Floats, Bools]:
    """Pixels (..., 2) of the photograph at normalised coordinates (..., 2) of the view, and
    whether they are visible (...)."""
    directions = _unit(points) @ face.rotation
    xy = pixels(wide.camera, directions)
    valid = wide.sees(xy)
    if wide.nadir > 0:
        valid &= directions[..., 1] < np.cos(wide.nadir)
    return xy, valid


def _unit(points: Floats) -> Floats:
    full = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
    return np.asarray(full / np.linalg.norm(full, axis=-1, keepdims=True))


def _in_face(name: str, directions: Floats) -> Bools:
    local = directions @ np.array(ROTATIONS[name], np.float64).T
    return np.asarray(np.abs(local[:, :2]).max(axis=1) <= REACH * local[:, 2])


def _face(wide: WideCamera, name: str, directions: Floats) -> Face:
    """The face cropped to ``directions``, (N, 3) rays inside it."""
    rotation = np.array(ROTATIONS[name], np.float64)
    fx, fy, _, _ = wide.camera.pinhole
    focal = float(np.sqrt(fx * fy))
    local = directions @ rotation.T
    plane = local[:, :2] / local[:, 2:]
    # Samples are a few pixels apart, more on the face's border than at its centre.
    margin = 2 * max(wide.camera.width, wide.camera.height) / SAMPLES / focal
    low, high = (np.clip(v, -REACH, REACH) for v in (plane.min(0) - margin, plane.max(0) + margin))
    side = 2 * REACH * MIN_SIDE
    low, high = np.minimum(low, np.clip(high - side, -REACH, None)), high
    high = np.maximum(high, low + side)
    x0, y0 = np.floor(low * focal - 1e-6)
    x1, y1 = np.ceil(high * focal + 1e-6)
    params = np.array([focal, focal, -x0, -y0])
    return Face(name, rotation, Camera("PINHOLE", int(x1 - x0), int(y1 - y0), params))
