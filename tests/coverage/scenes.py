"""Synthetic scenes of Gaussians, and cameras that see parts of them."""

from __future__ import annotations

import numpy as np
import torch

from pipeline.coverage.probe_views import Renderer
from pipeline.render import RasterOptions
from pipeline.render.views import Render, render_view
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

UP = np.array([0.0, -1.0, 0.0])


def camera(
    name: str,
    centre: tuple[float, float, float],
    target: tuple[float, float, float] | None = None,
    *,
    test: bool = False,
    focal: float = 60.0,
) -> View:
    """60 x 60 pixels at ``centre``, looking at ``target`` (straight ahead, along z, without one)
    with -y up."""
    ahead = np.array([0.0, 0.0, 1.0]) if target is None else np.subtract(target, centre)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, UP)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = -pose[:3, :3] @ np.array(centre, float)
    return View(name, "", None, 60, 60, focal, focal, 30.0, 30.0, pose, test)


def wall(
    x: tuple[float, float] = (-4, 4), y: tuple[float, float] = (-2, 2), z: float = 4.0
) -> Gaussians:
    """Opaque discs side by side in the plane ``z``."""
    step = 0.1
    columns, rows = np.meshgrid(np.arange(*x, step), np.arange(*y, step))
    means = np.stack([columns.ravel(), rows.ravel(), np.full(columns.size, z)], axis=1)
    return _discs(means, step)


def blobs(means: list[tuple[float, float, float]], size: float = 0.15) -> Gaussians:
    """Opaque balls."""
    return _discs(np.array(means), size, flat=False)


def _discs(means: np.ndarray, size: float, *, flat: bool = True) -> Gaussians:
    count = len(means)
    scales = np.full((count, 3), np.log(size))
    if flat:
        scales[:, 2] = np.log(1e-3)
    return Gaussians(
        torch.tensor(means, dtype=torch.float32),
        torch.tensor(scales, dtype=torch.float32),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        torch.full((count,), 6.0),
        torch.full((count, 1, 3), 0.5),
    )


def renderer(gaussians: Gaussians, threads: int = 1) -> Renderer:
    def render(view: View) -> Render:
        return render_view(gaussians, view, RasterOptions(threads=threads))

    return render
