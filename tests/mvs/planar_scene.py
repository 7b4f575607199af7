"""A scene folder of exact views of a plane, with sparse points on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.geometry.cameras import Camera
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.views import View
from tests.mvs import planar


def scene(folder: Path, width: int = 96, height: int = 72) -> tuple[list[View], Reconstruction]:
    """Views whose photographs are written into ``folder``, and their sparse model."""
    folder.mkdir(parents=True, exist_ok=True)
    views = []
    for picture in planar.pictures(width, height):
        view = replace(picture.view, name=f"a/{picture.view.name}.png")
        path = folder / f"{picture.view.name}.png"
        Image.fromarray(np.repeat(picture.grey[..., None], 3, 2)).save(path)
        views.append(replace(view, image=str(path)))
    first = views[0]
    rng = np.random.default_rng(1)
    pixel = rng.uniform(0.1, 0.9, (60, 2)) * (width, height)
    ray = np.column_stack([(pixel - (first.cx, first.cy)) / (first.fx, first.fy), np.ones(60)])
    return views, model_of(views, ray / (ray @ planar.NORMAL)[:, None])


def model_of(views: list[View], xyz: np.ndarray) -> Reconstruction:
    """A model whose points are all seen by all views."""
    count, number = len(xyz), len(views)
    points = Points(
        xyz,
        np.zeros((count, 3), np.uint8),
        np.zeros(count),
        np.arange(count + 1) * number,
        np.tile(np.arange(number), count),
        np.full((count * number, 2), np.nan),
    )
    view = views[0]
    params = np.array([view.fx, view.fy, view.cx, view.cy])
    images = {
        i: PosedImage(v.name, 1, v.world_to_camera[:3, :3], v.world_to_camera[:3, 3])
        for i, v in enumerate(views)
    }
    return Reconstruction({1: Camera("PINHOLE", view.width, view.height, params)}, images, points)
