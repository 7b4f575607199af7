"""The scenes that are measured: synthetic ones of known statistics, and trained models."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pipeline.raster import RasterCamera
from pipeline.scene.colmap import read_model
from pipeline.splats.order import morton_order
from pipeline.splats.ply import read_splat_ply

Arrays = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


@dataclass(frozen=True)
class Scene:
    """Gaussians and a view of them.

    Attributes:
        name: for people.
        gaussians: means, log_scales, quats, opacity_logits, sh, float32.
    """

    name: str
    gaussians: Arrays
    camera: RasterCamera

    @property
    def count(self) -> int:
        return len(self.gaussians[0])


def synthetic(count: int, width: int, height: int, radius: float) -> Scene:
    """Gaussians spread evenly over an image, as seen from the front; seeded by ``count``.

    On the image: 3-sigma radius log-normal with mean ``radius`` pixels and sigma 0.5, minor axis
    0.3 to 1 of the major one, any direction; depth 1 to 10; opacity logits normal with sigma 1.5.
    In the world: thin discs that face the camera, of spherical harmonics of degree 3. In Morton
    order, as training lays them.
    """
    rng = np.random.default_rng(count)
    focal = 1.2 * width
    pixel = rng.random((count, 2)) * [width, height]
    depth = 1 + 9 * rng.random(count)
    major = radius * np.exp(0.5 * rng.standard_normal(count) - 0.125) / 3
    minor = major * (0.3 + 0.7 * rng.random(count))
    angle = np.pi * rng.random(count)
    centre = np.array([width / 2, height / 2])
    means = np.column_stack([(pixel - centre) * depth[:, None] / focal, depth])
    scales = np.column_stack([major, minor, 0.1 * minor]) * depth[:, None] / focal
    zero = np.zeros(count)
    quats = np.column_stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)])
    sh = 0.05 * rng.standard_normal((count, 16, 3))
    sh[:, 0] = (rng.random((count, 3)) - 0.5) / 0.28209479177387814
    logits = 1.5 * rng.standard_normal(count)
    fields = (means, np.log(scales), quats, logits, sh)
    gaussians = tuple(torch.from_numpy(np.ascontiguousarray(f, np.float32)) for f in fields)
    camera = RasterCamera(
        width, height, focal, focal, width / 2, height / 2, torch.eye(4, dtype=torch.float64)
    )
    name = f"{count} at {width}x{height}, radius {radius:g}"
    order = morton_order(gaussians[0])
    return Scene(name, tuple(field[order] for field in gaussians), camera)  # type: ignore[arg-type]


def trained(folder: Path) -> Scene:
    """An export folder: its ``point_cloud.ply`` seen by the first image of its ``sparse/0``."""
    arrays = read_splat_ply(folder / "point_cloud.ply")
    model = read_model(folder / "sparse" / "0")
    posed = min(model.images.values(), key=lambda image: image.name)
    lens = model.cameras[posed.camera_id]
    camera = RasterCamera(
        lens.width, lens.height, *lens.pinhole, torch.from_numpy(posed.world_to_camera)
    )
    fields = (arrays.means, arrays.log_scales, arrays.quats, arrays.opacity_logits, arrays.sh)
    gaussians = tuple(torch.from_numpy(np.ascontiguousarray(f)) for f in fields)
    name = f"{folder}: {len(arrays)} at {lens.width}x{lens.height}, seen from {posed.name}"
    return Scene(name, gaussians, camera)  # type: ignore[arg-type]
