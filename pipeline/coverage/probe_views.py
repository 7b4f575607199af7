"""Probe views: reduced renders of a trained scene with depth, and which points they show."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.photos.load import load_mask, resize_mask
from pipeline.render.views import Render, to_bytes
from pipeline.scene.views import View, resized, view_size

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]
Renderer = Callable[[View], Render]

#: Longer side of a probe view, pixels.
SIDE = 128
#: A ray meets a surface if it accumulates at least this much opacity.
MIN_ALPHA = 0.5
#: Relative difference up to which a point's depth and a rendered depth are the same surface.
DEPTH_TOLERANCE = 0.03


@dataclass(frozen=True)
class ProbeView:
    """A camera at reduced size with a render of the trained scene.

    Attributes:
        view: The camera, reduced to ``SIDE`` unless ``render_probe`` got another side.
        focal: The focal length in pixels at the full size: the geometric mean of fx and fy.
        rgb: (H, W, 3) uint8 render.
        depth: (H, W) median depth (camera z, world units); inf if the ray meets no surface.
        min_depth, max_depth: (H, W) range of the finite depths in the 3 x 3 neighbourhood; inf if
            there is none.
        valid: (H, W) False in the masked pixels of the photograph.
    """

    view: View
    focal: float
    rgb: NDArray[np.uint8]
    depth: Floats
    min_depth: Floats
    max_depth: Floats
    valid: Bools

    @property
    def empty(self) -> Bools:
        """(H, W) True in pixels whose ray meets no surface."""
        return ~np.isfinite(self.depth)


@dataclass(frozen=True)
class QueryPoints:
    """Points that a query camera shows, for which the photographs' coverage is computed.

    Attributes:
        xyz: (N, 3) world; if the ray meets no surface, a point at the background depth.
        empty: (N,) True for points whose ray meets no surface.
        to_camera: (N, 3) unit vectors from the points to their query camera.
        resolution: (N,) pixels of the query camera per world unit at the point.
    """

    xyz: Doubles
    empty: Bools
    to_camera: Floats
    resolution: Floats

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True)
class Visibility:
    """Which of N points a camera sees.

    Attributes:
        visible: (M,) indices of the visible points: those on the surface that the camera renders.
        pixel: (M,) the pixels that show the visible points, in row-major order.
        seen_past: (N,) True if the camera renders a surface, or none, behind the point.
        occluded: (N,) True if the camera renders a surface in front of the point.
        to_camera: (M, 3) unit vectors from the visible points to the camera.
        resolution: (M,) pixels of the camera at full size per world unit at the visible points.
    """

    visible: NDArray[np.intp]
    pixel: NDArray[np.intp]
    seen_past: Bools
    occluded: Bools
    to_camera: Floats
    resolution: Floats


def reduced(view: View, side: int = SIDE) -> View:
    """The view scaled down so that no side is longer than ``side`` pixels."""
    return resized(view, *view_size(view.width, view.height, side))


def render_probe(view: View, render: Renderer, side: int = SIDE) -> ProbeView:
    """Render a view, reduced to ``side``."""
    small = reduced(view, side)
    rendered = render(small)
    on_surface = (rendered.alpha >= MIN_ALPHA) & (rendered.median_depth > 0)
    depth = np.where(on_surface, rendered.median_depth, np.float32(np.inf))
    valid = np.ones(depth.shape, bool)
    if view.mask is not None:
        valid = resize_mask(load_mask(view.mask, view.mask_digest), small.width, small.height)
    min_depth, max_depth = _neighbourhood_range(depth)
    focal = float(np.sqrt(view.fx * view.fy))
    rgb = to_bytes(rendered.rgb)
    return ProbeView(small, focal, rgb, depth, min_depth, max_depth, valid)


def render_probes(views: Sequence[View], render: Renderer) -> Iterator[ProbeView]:
    """``render_probe`` of each view, in order; one at a time, since each takes memory for all
    Gaussians."""
    return (render_probe(view, render) for view in views)


def _neighbourhood_range(depth: Floats) -> tuple[Floats, Floats]:
    """Minimum and maximum of the finite depths in each 3 x 3 neighbourhood; inf without any."""
    shifted = neighbourhood(depth)
    minimum = np.minimum.reduce(shifted)
    maximum = np.maximum.reduce([np.where(np.isfinite(part), part, 0) for part in shifted])
    return minimum, np.where(maximum > 0, maximum, np.float32(np.inf))


def neighbourhood(values: NDArray[Any]) -> list[NDArray[Any]]:
    """The nine images (H, W, ...) that have at each pixel a pixel of its 3 x 3 neighbourhood;
    edges are repeated."""
    height, width = values.shape[:2]
    padded = np.pad(values, [(1, 1), (1, 1), *[(0, 0)] * (values.ndim - 2)], mode="edge")
    return [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]


def backproject(probe: ProbeView, background_depth: float, step: int = 1) -> QueryPoints:
    """The world points that the pixels show, in row-major order.

    Args:
        background_depth: The depth of pixels whose ray meets no surface, world units.
        step: The stride in pixels, in both directions.
    """
    view, sampled = probe.view, slice(step // 2, None, step)
    depth = probe.depth[sampled, sampled]
    x = ((np.arange(view.width) + 0.5 - view.cx) / view.fx)[sampled]
    y = ((np.arange(view.height) + 0.5 - view.cy) / view.fy)[sampled]
    local = np.stack([*np.meshgrid(x, y), np.ones(depth.shape)], axis=-1).reshape(-1, 3)
    rays = rotate(local, view.world_to_camera[:3, :3].T)
    on_surface = np.isfinite(depth).ravel()
    z = np.where(on_surface, depth.ravel(), background_depth)
    to_camera = -rays / np.sqrt((rays**2).sum(axis=1, keepdims=True))
    return QueryPoints(
        view.centre + z[:, None] * rays,
        ~on_surface,
        to_camera.astype(np.float32),
        (probe.focal / z).astype(np.float32),
    )


def find_visible(probe: ProbeView, xyz: Doubles, empty: Bools) -> Visibility:
    """Compare points with the depth map of a probe view.

    Args:
        xyz: (N, 3) world.
        empty: (N,) True for background points, which lie on no surface: they are visible in pixels
            whose ray meets no surface.
    """
    inside, pixel, z = project(probe.view, xyz)
    valid = probe.valid.ravel()[pixel]
    inside, pixel = inside[valid], pixel[valid]
    depth, nearest = z[inside], probe.min_depth.ravel()[pixel]
    farthest = probe.max_depth.ravel()[pixel]
    in_front = depth < nearest * (1 - DEPTH_TOLERANCE)
    on_surface = ~in_front & (depth <= farthest * (1 + DEPTH_TOLERANCE)) & np.isfinite(nearest)
    found = np.where(empty[inside], probe.empty.ravel()[pixel], on_surface)
    seen_past, occluded = np.zeros((2, len(xyz)), bool)
    seen_past[inside], occluded[inside] = in_front & ~found, ~in_front & ~found
    visible = inside[found]
    to_camera = (probe.view.centre - xyz[visible]).astype(np.float32)
    to_camera = to_camera / np.sqrt((to_camera**2).sum(axis=1, keepdims=True))
    resolution = (probe.focal / z[visible]).astype(np.float32)
    return Visibility(visible, pixel[found], seen_past, occluded, to_camera, resolution)


def project(view: View, xyz: Doubles) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Project points into a view.

    Args:
        xyz: (N, 3) world.

    Returns:
        (M,) indices of the points inside the image, (M,) the pixels that contain them, in row-major
        order, and (N,) camera z of all points.
    """
    # Subtracted in double precision: scenes may lie far from the origin.
    offset = (xyz - view.centre).astype(np.float32)
    x, y, z = _columns(offset, view.world_to_camera[:3, :3].astype(np.float32))
    inverse = 1 / np.where(z > 0, z, np.float32(np.inf))
    column = x * inverse * np.float32(view.fx) + np.float32(view.cx)
    row = y * inverse * np.float32(view.fy) + np.float32(view.cy)
    inside = np.flatnonzero(
        (z > 0) & (column >= 0) & (row >= 0) & (column < view.width) & (row < view.height)
    )
    pixel = row[inside].astype(np.intp) * view.width + column[inside].astype(np.intp)
    return inside, pixel, z


def rotate(vectors: NDArray[Any], rotation: NDArray[Any]) -> NDArray[Any]:
    """(N, 3) vectors, each multiplied by a (3, 3) matrix."""
    return np.stack(_columns(vectors, rotation), axis=1)


def _columns(vectors: NDArray[Any], rotation: NDArray[Any]) -> list[NDArray[Any]]:
    """The columns of ``vectors @ rotation.T``.

    Written out, because a matrix product may round differently with the number of threads.
    """
    x, y, z = vectors.T
    return [x * row[0] + y * row[1] + z * row[2] for row in rotation]
