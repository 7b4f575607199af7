"""Exact depth maps of simple scenes, from cameras on a ring."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.demo.cameras import lens, look_at, orbit
from pipeline.demo.scene import OBJECTS, trace
from pipeline.scene.views import View
from pipeline.surface.depth import DepthMap


def view_at(centre, target, size=96, focal=110.0, name="view"):
    """A square view that looks at a point; the world's z is up."""
    rotation = look_at(np.asarray(centre, float), np.asarray(target, float))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(centre, float)
    half = size / 2
    return View(name, "", None, size, size, focal, focal, half, half, pose, False)


def rays(view: View) -> np.ndarray:
    """(H * W, 3) directions of depth 1 in the world."""
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    local = np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones_like(x)], axis=-1)
    return local.reshape(-1, 3) @ view.world_to_camera[:3, :3]


class Maps:
    """Replaces ``DepthMaps``, without Gaussians and files."""

    def __init__(self, maps: list[DepthMap]):
        self._maps = maps

    def __len__(self) -> int:
        return len(self._maps)

    def __iter__(self) -> Iterator[DepthMap]:
        return iter(self._maps)


def ball(radius=1.0, views=14, size=96) -> Maps:
    """A ball at the origin, red for x > 0, blue elsewhere, on an empty background."""
    maps = []
    for i in range(views):
        # Fibonacci's sphere: no direction is left out.
        z = 1 - (2 * i + 1) / views
        angle = i * np.pi * (3 - np.sqrt(5))
        flat = np.sqrt(1 - z * z)
        centre = 3 * np.array([flat * np.cos(angle), flat * np.sin(angle), z])
        view = view_at(centre, (0, 0, 0), size, focal=1.2 * size)
        direction = rays(view)
        a, b = (direction**2).sum(1), direction @ view.centre
        inner = b * b - a * (view.centre @ view.centre - radius**2)
        depth = np.where(inner > 0, (-b - np.sqrt(np.maximum(inner, 0))) / a, np.inf)
        hit = view.centre + np.where(np.isfinite(depth), depth, 0)[:, None] * direction
        rgb = np.where(hit[:, :1] > 0, (200, 0, 0), (0, 0, 200)).astype(np.uint8)
        maps.append(
            DepthMap(
                view,
                depth.astype(np.float32).reshape(size, size),
                rgb.reshape(size, size, 3),
            )
        )
    return Maps(maps)


def demo_room(views=16, width=160, height=120) -> tuple[Maps, list[View]]:
    """Exact depths of the demo scene."""
    camera = lens("none", width, height)
    fx, fy, cx, cy = camera.pinhole
    maps = []
    # Twelve degrees at most lie between the demo's neighbours: take every second of thirty.
    ring = orbit([f"view_{i:03d}" for i in range(2 * views)], 0)[::2]
    for posed in ring:
        view = View(
            posed.name, "", None, width, height, fx, fy, cx, cy, posed.world_to_camera, False
        )
        depth, _ = trace(posed.centre[:, None], rays(view).T, OBJECTS)
        grey = np.full((height, width, 3), 90, np.uint8)
        maps.append(DepthMap(view, depth.astype(np.float32).reshape(height, width), grey))
    return Maps(maps), [depth.view for depth in maps]
