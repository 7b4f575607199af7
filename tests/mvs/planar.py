"""Exact views of a textured plane, made by its homographies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.mvs.patchmatch import Picture
from pipeline.scene.views import View

# The plane n . X = 1 in the coordinates of the first camera, slanted by about 40 degrees.
NORMAL = np.array([0.12, -0.09, 0.2])
CENTRES = ((0.0, 0.0, 0.0), (0.6, 0.1, 0.0), (-0.5, 0.3, 0.1), (0.1, -0.6, -0.1))


def view(centre: Sequence[float], width: int, height: int, name: str = "view") -> View:
    """A camera that looks along z, turned a little."""
    turn = 0.05 * centre[0]
    rotation = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.array(centre)
    focal = 1.1 * max(width, height)
    cx, cy = width / 2 + 1.5, height / 2 - 0.5
    return View(name, "", None, width, height, focal, 1.02 * focal, cx, cy, pose, False)


def rays(camera: View) -> NDArray[np.float64]:
    """(H, W, 3) rays with z = 1 in the camera's frame."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)


def depth(camera: View) -> NDArray[np.float64]:
    """(H, W) camera z of the plane."""
    world = np.einsum("ji,hwj->hwi", camera.world_to_camera[:3, :3], rays(camera))
    return np.asarray((1.0 - NORMAL @ camera.centre) / (world @ NORMAL))


def picture(camera: View) -> Picture:
    """The camera's image of a smooth random texture on the plane."""
    local = rays(camera) * depth(camera)[..., None] - camera.world_to_camera[:3, 3]
    world = np.einsum("ji,hwj->hwi", camera.world_to_camera[:3, :3], local)
    rng = np.random.default_rng(3)
    grey = np.full((camera.height, camera.width), 128.0)
    for _ in range(24):
        wave = rng.normal(size=3) * 5
        grey += 18 * np.sin(world @ wave + rng.uniform(0, 6))
    grey = grey.clip(0, 255).round().astype(np.uint8)
    return Picture(camera, grey, np.ones(grey.shape, bool))


def pictures(width: int = 96, height: int = 72, count: int = 4) -> list[Picture]:
    """The reference and its sources."""
    return [picture(view(c, width, height, f"{i}")) for i, c in enumerate(CENTRES[:count])]


def true_planes(camera: View) -> NDArray[np.float32]:
    """(3, H, W) planes of the pixels of the first camera: inverse depth is affine in the pixel."""
    inverse = 1.0 / depth(camera)
    wx = np.full(inverse.shape, NORMAL[0] / camera.fx)
    wy = np.full(inverse.shape, NORMAL[1] / camera.fy)
    return np.stack([inverse, wx, wy]).astype(np.float32)
