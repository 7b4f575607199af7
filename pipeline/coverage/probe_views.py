"""What cameras see of a trained scene: small renders of it, and points looked for in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.photos.load import load_mask, resize_mask
from pipeline.render.views import Render
from pipeline.scene.views import View, view_size

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]
Draw = Callable[[View], Render]

#: Renders are reduced to this, pixels on the longer side.
SIDE = 128
#: Rays that less opacity stops meet no surface.
MIN_ALPHA = 0.5
#: Depths of one surface, rendered from two sides, agree to this share.
AGREEMENT = 0.03


@dataclass(frozen=True)
class Eye:
    """A camera and the surface it has in front.

    Attributes:
        view: reduced to ``SIDE``.
        focal: pixels at the view's own size; the geometric mean of fx and fy.
        rgb: (H, W, 3) float32 render in [0, 1].
        depth: (H, W) camera z of the surface, world unit; inf where there is none.
        near, far: (H, W) least and largest depth within a pixel around; inf where there is none.
        counts: (H, W) False where the photograph is masked.
    """

    view: View
    focal: float
    rgb: Floats
    depth: Floats
    near: Floats
    far: Floats
    counts: Bools

    @property
    def open(self) -> Bools:
        """(H, W) True where the ray meets no surface."""
        return ~np.isfinite(self.depth)


@dataclass(frozen=True)
class Points:
    """Points of the surface, each with the camera that asks for it.

    Attributes:
        xyz: (N, 3) world; where a ray met no surface, a point far out on it.
        open: (N,) True for those.
        towards: (N, 3) unit vectors from the points to their asking camera.
        sharpness: (N,) pixels of the asking camera in a world unit at the point.
    """

    xyz: Doubles
    open: Bools
    towards: Floats
    sharpness: Floats

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True)
class Sighting:
    """What one camera sees of points.

    Attributes:
        seen: (M,) indices of the points that lie on the surface which the camera has in front.
        passed: (N,) the camera sees past the point, to something behind.
        hidden: (N,) the surface in front hides the point.
        towards: (M, 3) unit vectors from the seen points to the camera.
        sharpness: (M,) pixels of the camera's own size in a world unit at the seen points.
    """

    seen: NDArray[np.intp]
    passed: Bools
    hidden: Bools
    towards: Floats
    sharpness: Floats


def reduced(view: View, side: int = SIDE) -> View:
    """The view with no side longer than ``side`` pixels."""
    width, height = view_size(view.width, view.height, side)
    sx, sy = width / view.width, height / view.height
    return replace(
        view,
        width=width,
        height=height,
        fx=view.fx * sx,
        fy=view.fy * sy,
        cx=view.cx * sx,
        cy=view.cy * sy,
    )


def open_eye(view: View, draw: Draw) -> Eye:
    """Render a view at reduced size."""
    small = reduced(view)
    drawn = draw(small)
    met = (drawn.alpha >= MIN_ALPHA) & (drawn.median_depth > 0)
    depth = np.where(met, drawn.median_depth, np.float32(np.inf))
    counts = np.ones(depth.shape, bool)
    if view.mask is not None:
        counts = resize_mask(load_mask(view.mask, view.mask_digest), small.width, small.height)
    near, far = _windows(depth)
    focal = float(np.sqrt(view.fx * view.fy))
    return Eye(small, focal, drawn.rgb, depth, near, far, counts)


def open_eyes(views: Sequence[View], draw: Draw, threads: int) -> Iterator[Eye]:
    """``open_eye`` of each view in order, ``threads`` at a time: renders so small leave the
    rasterizer's own threads little to share."""
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        yield from pool.map(lambda view: open_eye(view, draw), views)


def _windows(depth: Floats) -> tuple[Floats, Floats]:
    """Least and largest depth of 3 by 3 pixels, of those where there is any."""
    height, width = depth.shape
    around = np.pad(depth, 1, mode="edge")
    parts = [around[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    near = np.minimum.reduce(parts)
    far = np.maximum.reduce([np.where(np.isfinite(part), part, 0) for part in parts])
    return near, np.where(far > 0, far, np.float32(np.inf))


def points_of(eye: Eye, beyond: float, step: int = 1) -> Points:
    """A point for each pixel, row by row.

    Args:
        beyond: depth to take where the ray meets no surface, world unit.
        step: each this-many-th pixel of each this-many-th row, from the middle of the first.
    """
    view, pick = eye.view, slice(step // 2, None, step)
    depth = eye.depth[pick, pick]
    x = ((np.arange(view.width) + 0.5 - view.cx) / view.fx)[pick]
    y = ((np.arange(view.height) + 0.5 - view.cy) / view.fy)[pick]
    local = np.stack([*np.meshgrid(x, y), np.ones(depth.shape)], axis=-1).reshape(-1, 3)
    rays = turned(local, view.world_to_camera[:3, :3].T)
    met = np.isfinite(depth).ravel()
    z = np.where(met, depth.ravel(), beyond)
    towards = -rays / np.sqrt((rays**2).sum(axis=1, keepdims=True))
    return Points(
        view.centre + z[:, None] * rays,
        ~met,
        towards.astype(np.float32),
        (eye.focal / z).astype(np.float32),
    )


def look_for(eye: Eye, xyz: Doubles, open_: Bools) -> Sighting:
    """Look for points in a camera's depth map.

    Args:
        xyz: (N, 3) world.
        open_: (N,) points that stand for no surface: they are seen where the camera has none,
            either.
    """
    view = eye.view
    # Relative to the camera in double precision: worlds may lie far from their origin.
    offset = (xyz - view.centre).astype(np.float32)
    x, y, z = _columns(offset, view.world_to_camera[:3, :3].astype(np.float32))
    inverse = 1 / np.where(z > 0, z, np.float32(np.inf))
    column = x * inverse * np.float32(view.fx) + np.float32(view.cx)
    row = y * inverse * np.float32(view.fy) + np.float32(view.cy)
    inside = np.flatnonzero(
        (z > 0) & (column >= 0) & (row >= 0) & (column < view.width) & (row < view.height)
    )
    place = row[inside].astype(np.intp) * view.width + column[inside].astype(np.intp)
    counts = eye.counts.ravel()[place]
    inside, place = inside[counts], place[counts]
    depth, near = z[inside], eye.near.ravel()[place]
    before = depth < near * (1 - AGREEMENT)
    met = ~before & (depth <= eye.far.ravel()[place] * (1 + AGREEMENT)) & np.isfinite(near)
    nothing = eye.open.ravel()[place]
    found = np.where(open_[inside], nothing, met)
    passed, hidden = np.zeros((2, len(xyz)), bool)
    passed[inside], hidden[inside] = before & ~found, ~before & ~found
    seen = inside[found]
    back = -offset[seen]
    length = np.sqrt((back**2).sum(axis=1, keepdims=True))
    return Sighting(seen, passed, hidden, back / length, (eye.focal / z[seen]).astype(np.float32))


def turned(vectors: NDArray[Any], rotation: NDArray[Any]) -> NDArray[Any]:
    """(N, 3) vectors turned by a (3, 3) matrix."""
    return np.stack(_columns(vectors, rotation), axis=1)


def _columns(vectors: NDArray[Any], rotation: NDArray[Any]) -> list[NDArray[Any]]:
    """Written out: a matrix product may round differently with other threads."""
    x, y, z = vectors.T
    return [x * row[0] + y * row[1] + z * row[2] for row in rotation]
