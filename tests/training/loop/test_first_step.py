"""The first step in detail: longer runs hide wrong learning rates and gradients."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from pipeline.render import make_backend
from pipeline.scene.exposure import ViewLight
from pipeline.splats.morton import in_morton_order
from pipeline.training.data.inputs import Inputs
from pipeline.training.density.strategy import rotations
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from tests.training.conftest import TinyScene, tiny_config

RATES = {
    "means_learning_rate": 1e-3,
    "scales_learning_rate": 2e-3,
    "quats_learning_rate": 3e-3,
    "opacities_learning_rate": 5e-3,
    "sh0_learning_rate": 7e-3,
    "adam_epsilon": 0.0,
    "learning_rate_factor": 2.0,
    "learning_rate_final_factor": 1.0,
}


@pytest.mark.parametrize("unit", ["gaussian_scale", "scene_scale", "camera_extent"])
def test_each_parameter_has_its_own_learning_rate(
    scene: TinyScene, tmp_path: Path, unit: str
) -> None:
    """Adam's first step is the rate itself, up or down: along and about each Gaussian's own axes,
    the means' in its scales; or a row's root mean square where the row shares a second moment, the
    means' in the scene's size."""
    scale = 3.0
    world_unit = scene.extent if unit == "camera_extent" else scale
    result = train(
        Inputs(scene.views, scene.initial, scene.extent, scale),
        TrainingRun(
            tiny_config(1, **RATES, means_learning_rate_unit=unit), tmp_path, seed=0, threads=1
        ),
    )
    expected = {
        "means": RATES["means_learning_rate"],
        "log_scales": RATES["scales_learning_rate"],
        "quats": RATES["quats_learning_rate"],
        "opacity_logits": RATES["opacities_learning_rate"],
        "sh": RATES["sh0_learning_rate"],
    }
    for name, tensor in result.gaussians.tensors().items():
        first = in_morton_order(scene.initial).with_sh_degree(result.gaussians.sh_degree)
        before = first.tensors()[name]
        steps = tensor - before
        if name == "means" and unit == "gaussian_scale":
            axes = rotations(first.quats)
            steps = torch.einsum("nij,ni->nj", axes, steps) / first.log_scales.exp()
        elif name == "means":
            steps = steps.square().mean(1).sqrt() / world_unit
        elif name == "sh":
            steps = steps.square().mean(2).sqrt()
        elif name == "quats":
            steps = steps.square().mean(1).sqrt()
            if unit == "gaussian_scale":  # three ways to turn a quaternion of length 1
                steps *= math.sqrt(4 / 3) / before.norm(dim=1)
        moved = float(steps.abs().max())
        assert moved == pytest.approx(2.0 * expected[name], rel=1e-3), name


def test_the_gradient_is_that_of_the_loss(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With exposure gains, vignetting and a slope, against finite differences of the image."""
    seen: dict[str, Any] = {}
    update, loss = make_backend().update, make_backend().l1_ssim

    def watched_update(rendered: Any, parameters: Any, of_images: Any, **named: Any) -> Any:
        seen["color"], seen["d_color"] = rendered.color.clone(), of_images.color.clone()
        return update(rendered, parameters, of_images, **named)

    def watched_loss(picture: Any, *rest: Any, factor: Any = None) -> Any:
        seen["wanted_and_weights"] = rest
        return loss(picture, *rest, factor=factor)

    monkeypatch.setattr(make_backend(), "update", watched_update)
    monkeypatch.setattr(make_backend(), "l1_ssim", watched_loss)
    light = [ViewLight(gain=(0.4, 1.0, 2.5), vignetting=(-0.5, -0.3), slope=(0.4, -0.6))]
    train(
        Inputs(scene.views, scene.initial, scene.extent, light=light * len(scene.views)),
        TrainingRun(tiny_config(1), tmp_path, seed=0, threads=1),
    )
    factor = torch.from_numpy(light[0].factor(scene.views[0]))

    def measured(picture: torch.Tensor) -> float:
        return make_backend().l1_ssim(picture * factor, *seen["wanted_and_weights"]).loss

    for channel in range(3):
        step = torch.zeros_like(seen["color"])
        step[..., channel] = 1e-3 * torch.sign(seen["d_color"][..., channel])
        slope = (measured(seen["color"] + step) - measured(seen["color"] - step)) / 2
        assert slope == pytest.approx(float((step * seen["d_color"]).sum()), rel=0.05)
