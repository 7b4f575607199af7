"""Measured scenes: synthetic ones of known statistics, and trained models."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import read_model
from pipeline.io.ply import read_splat_ply
from pipeline.io.spz import read_spz
from pipeline.render import RasterCamera
from pipeline.splats.morton import morton_order

MAX_VIEWS = 16  # The views of a trained model, evenly spread over its images.

Arrays = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


@dataclass(frozen=True)
class Scene:
    """Gaussians with views.

    Attributes:
        name: A description of the scene.
        gaussians: The float32 tensors means, log_scales, quats, opacity_logits and sh.
        views: Cameras of one size; a training step is measured with the first.
    """

    name: str
    gaussians: Arrays
    views: tuple[RasterCamera, ...]

    @property
    def camera(self) -> RasterCamera:
        return self.views[0]

    @property
    def count(self) -> int:
        return len(self.gaussians[0])


def synthetic(count: int, width: int, height: int, radius: float, in_view: float = 1.0) -> Scene:
    """Gaussians spread evenly over an image; the seed is ``count``.

    A share of ``in_view`` lies in the image, the others around it, as in a scene that no view shows
    whole.

    On the image: 3-sigma radius log-normal with mean ``radius`` pixels and sigma 0.5, minor axis
    0.3 to 1 of the major one, any direction; depth 1 to 10; opacity logits normal with sigma 1.5.
    In the world: thin discs that face the camera, of spherical harmonics of degree 3. In Morton
    order, as training lays them.
    """
    rng = np.random.default_rng(count)
    focal = 1.2 * width
    pixel = ((rng.random((count, 2)) - 0.5) / np.sqrt(in_view) + 0.5) * [width, height]
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
    if in_view < 1:
        name += f", {in_view:g} of them in view"
    order = morton_order(gaussians[0])
    ordered = tuple(field[order] for field in gaussians)
    return Scene(name, ordered, (camera,))  # type: ignore[arg-type]


def trained(folder: Path, size: tuple[int, int] | None = None) -> Scene:
    """An export folder: its ``point_cloud.ply``, or without it ``point_cloud.spz``, seen by the
    images of its ``sparse/0``. Every image is stretched to ``size`` (width, height), or to the size
    of the first one."""
    file = folder / "point_cloud.ply"
    arrays = read_splat_ply(file) if file.exists() else read_spz(file.with_suffix(".spz"))
    model = read_model(folder / "sparse" / "0")
    posed = sorted(model.images.values(), key=lambda image: image.name)
    lens = model.cameras[posed[0].camera_id]
    width, height = size or (lens.width, lens.height)
    step = max(1, len(posed) // MAX_VIEWS)
    views = [
        _view(model.cameras[image.camera_id].resized(width, height), image.world_to_camera)
        for image in posed[::step][:MAX_VIEWS]
    ]
    fields = (arrays.means, arrays.log_scales, arrays.quats, arrays.opacity_logits, arrays.sh)
    gaussians = tuple(torch.from_numpy(np.ascontiguousarray(f)) for f in fields)
    name = f"{folder}: {len(arrays)} at {width}x{height}, seen from {posed[0].name}"
    return Scene(name, gaussians, tuple(views))  # type: ignore[arg-type]


def _view(camera: Camera, pose: np.ndarray) -> RasterCamera:
    return RasterCamera(camera.width, camera.height, *camera.pinhole, torch.from_numpy(pose))


def size_of(text: str) -> tuple[int, int]:
    """The width and height of "WIDTHxHEIGHT", on a command line."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT, found {text!r}")
    return int(width), int(height)
