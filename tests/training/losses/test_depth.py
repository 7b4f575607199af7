"""Known depths of sparse points, and the depth loss."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.config.density import Gradient
from pipeline.config.experiments import TrainExperiments
from pipeline.config.settled import TrainOptions
from pipeline.geometry.cameras import Camera
from pipeline.render import Forward
from pipeline.render.views import render_view
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.inputs import Inputs
from pipeline.training.data.known_depths import KnownDepths, point_depths, scene_scale
from pipeline.training.loop.train import train
from pipeline.training.losses.depth import TOLERANCE, depth_gradients
from pipeline.training.run import TrainingRun
from tests.training.conftest import HEIGHT, WIDTH, camera_at


def test_depths_are_known_in_the_views_that_see_a_point():
    views = [replace(camera_at(angle), name=f"{i}.png") for i, angle in enumerate((0.0, 0.4))]
    images = {
        7 + i: PosedImage(v.name, 1, v.world_to_camera[:3, :3], v.world_to_camera[:3, 3])
        for i, v in enumerate(views)
    }
    points = Points(
        xyz=np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.3], [0.0, 0.0, -9.0]]),
        rgb=np.zeros((3, 3), np.uint8),
        error=np.zeros(3),
        track_start=np.array([0, 2, 3, 4]),
        track_image_id=np.array([8, 7, 8, 7]),
        track_xy=np.full((4, 2), np.nan),
    )
    camera = Camera("SIMPLE_PINHOLE", WIDTH, HEIGHT, np.array([40.0, WIDTH / 2, HEIGHT / 2]))
    first, second = point_depths(views, Reconstruction({1: camera}, images, points))
    # The third point lies behind the first camera.
    assert (len(first), len(second)) == (1, 2)
    away = np.linalg.norm(views[0].centre - points.xyz[0])
    x, y = (first.xy[0] - (views[0].cx, views[0].cy)) / (views[0].fx, views[0].fy)
    assert first.z[0] * np.sqrt(1 + x * x + y * y) == pytest.approx(away, rel=1e-6)
    assert second.weight.mean() == pytest.approx(1.0)
    assert second.weight[0] == pytest.approx(2 * second.weight[1])


def depths(*values: float) -> KnownDepths:
    n = len(values)
    return KnownDepths(np.zeros((n, 2)), np.array(values, np.float32), np.ones(n, np.float32))


@pytest.mark.parametrize("unit", [1.0, 1e-4])
def test_the_scene_scale_is_the_smaller_of_extent_and_half_the_median_depth(unit: float) -> None:
    """Cameras 100 apart of which none sees farther than 8: steps measured by the 100 went through
    the walls, and each camera got fog of its own."""
    street = [depths(3 * unit, 4 * unit), depths(), depths(8 * unit)]
    assert scene_scale(100 * unit, street) == pytest.approx(2 * unit)
    assert scene_scale(1.5 * unit, street) == 1.5 * unit
    assert scene_scale(3 * unit, [depths()]) == scene_scale(3 * unit, []) == 3 * unit


def test_gradients_are_those_of_the_documented_loss():
    view = camera_at(0.0)
    known = KnownDepths(
        np.array([[3.2, 4.9], [3.9, 4.1], [39.9, 31.9], [20.0, 8.0]]),
        np.array([2.0, 2.5, 3.0, 1.0], np.float32),
        np.array([0.5, 1.0, 1.5, 1.0], np.float32),
    )
    generator = torch.Generator().manual_seed(0)
    alpha = 0.3 + 0.6 * torch.rand(HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    depth = alpha * (2.5 + torch.rand(HEIGHT, WIDTH, generator=generator, dtype=torch.float64))
    alpha[8, 20] = 0.01  # too transparent to have a depth
    depth[31, 39] = alpha[31, 39] * 3.004  # within the tolerance
    alpha.requires_grad_(), depth.requires_grad_()
    rows, columns = torch.tensor([4, 4, 31]), torch.tensor([3, 3, 39])
    off = (depth[rows, columns] / alpha[rows, columns] / torch.from_numpy(known.z[:3])).log()
    huber = torch.nn.functional.huber_loss(off, 0 * off, reduction="none", delta=TOLERANCE)
    (0.3 * (huber / TOLERANCE * torch.from_numpy(known.weight[:3])).sum() / 4).backward()
    drawn = SimpleNamespace(alpha=alpha.detach().float(), depth=depth.detach().float())
    d_alpha, d_depth = depth_gradients(cast(Forward, drawn), known, view, 0.3)
    assert alpha.grad is not None and depth.grad is not None
    torch.testing.assert_close(d_alpha.double(), alpha.grad, rtol=1e-3, atol=1e-9)
    torch.testing.assert_close(d_depth.double(), depth.grad, rtol=1e-3, atol=1e-9)


def grey_wall(folder: Path) -> tuple[View, Gaussians]:
    """One photograph of a wall without features at z = 3, and Gaussians that start at z = 2."""
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 128, np.uint8)).save(folder / "wall.png")
    view = replace(
        camera_at(0.0), name="wall.png", image=str(folder / "wall.png"), world_to_camera=np.eye(4)
    )
    x, y = np.meshgrid(np.linspace(-1, 1, 12), np.linspace(-0.8, 0.8, 10))
    n = x.size
    return view, Gaussians.from_arrays(
        {
            "means": np.stack([x.ravel(), y.ravel(), np.full(n, 2.0)], 1),
            "log_scales": np.full((n, 3), np.log(0.12)),
            "quats": np.tile([1.0, 0, 0, 0], (n, 1)),
            "opacity_logits": np.full(n, 2.0),
            "sh": np.zeros((n, 1, 3)),
        }
    )


@pytest.mark.parametrize("weight", [0.0, 0.1])
def test_training_moves_a_wall_without_features_to_its_known_depth(tmp_path, weight):
    view, initial = grey_wall(tmp_path)
    x, y = np.meshgrid(np.arange(2, WIDTH, 4) + 0.5, np.arange(2, HEIGHT, 4) + 0.5)
    xy = np.stack([x.ravel(), y.ravel()], 1)
    known = KnownDepths(xy, np.full(len(xy), 3.0, np.float32), np.ones(len(xy), np.float32))
    options = TrainOptions(
        steps=200,
        sh_degree=0,
        depth_loss_weight=weight,
        density=Gradient(max_gaussians=120),
        experiments=TrainExperiments(
            coarse_share=0.0,
            means_learning_rate=0.02,
            means_final_learning_rate=0.02,
            means_learning_rate_unit="scene_scale",
            learning_rate_factor=1.0,
            dropout=0.0,
        ),
    )
    result = train(
        Inputs([view], initial, extent=1.0, depths=[known]),
        TrainingRun(options, tmp_path / "checkpoints"),
    )
    render = render_view(result.gaussians, view)
    depth = float(np.median((render.depth / render.alpha)[8:-8, 8:-8]))
    assert depth == pytest.approx(3.0, abs=0.1) if weight else depth < 2.5
