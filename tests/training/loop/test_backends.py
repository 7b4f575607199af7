"""Training uses only the interface of a backend: the float64 reference trains as well."""

from __future__ import annotations

from pathlib import Path

import torch

from pipeline.render import make_backend
from pipeline.splats.morton import in_morton_order
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from tests.training.conftest import TinyScene, tiny_config


def test_the_reference_trains_what_the_kernels_train(scene: TinyScene, tmp_path: Path) -> None:
    inputs = Inputs(scene.views, scene.initial, scene.extent)
    kernels, reference = (
        train(
            inputs,
            TrainingRun(tiny_config(4), tmp_path / name, seed=0, threads=1),
            backend=make_backend(name),
        )
        for name in ("cpu", "reference")
    )
    moved = (kernels.gaussians.means - in_morton_order(scene.initial).means).abs().max()
    assert moved > 1e-3
    for name, tensor in kernels.gaussians.tensors().items():
        other = reference.gaussians.tensors()[name]
        assert torch.allclose(tensor, other, atol=1e-5), name
