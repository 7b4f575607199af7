"""The measured step is one of training, on either device, and leaves the scene as it is."""

from __future__ import annotations

import torch

from pipeline.render import Backend, RasterOptions
from pipeline.render.calibration import made_scene, step_seconds, training_step


def test_a_step_is_timed(backend: Backend) -> None:
    assert 0 < step_seconds(backend, gaussians=300, steps=1) < 60


def test_the_step_can_be_repeated(backend: Backend) -> None:
    scene = made_scene(200)
    before = [tensor.clone() for tensor in scene.gaussians]
    assert backend.forward(*scene.gaussians, scene.camera, RasterOptions()).num_visible > 150
    step = training_step(backend, scene)
    for _ in range(2):
        step()
    assert all(map(torch.equal, scene.gaussians, before))
