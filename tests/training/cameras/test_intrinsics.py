"""Refinement of intrinsics recovers inaccurate focal lengths and principal points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.geometry.cameras import Camera
from pipeline.render.views import raster_camera
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from pipeline.scene.views import View
from pipeline.training.cameras.intrinsics import (
    IntrinsicsRefinement,
    describe_intrinsics,
    with_intrinsics,
)
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.result import TrainResult
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from tests.training.conftest import TinyScene, killed_in_step, tiny_config

STILL = ("means", "scales", "quats", "opacities", "sh0", "shN")
# Logarithm of the focal length, principal point across and down in focal lengths.
WRONG = np.array([0.03, -0.02, 0.015])


def wrong(view: View) -> View:
    """The view with a camera of its own, whose intrinsics are wrong."""
    factor = float(np.exp(WRONG[0]))
    return replace(
        view,
        camera_id=7,
        fx=view.fx * factor,
        fy=view.fy * factor,
        cx=view.cx + WRONG[1] * view.fx,
        cy=view.cy + WRONG[2] * view.fx,
    )


def trained(scene: TinyScene, folder: Path, steps: int, **options: object) -> TrainResult:
    """Train with fixed, correct Gaussians; every third view has wrong intrinsics."""
    views = [wrong(v) if i % 3 == 0 else v for i, v in enumerate(scene.views)]
    options |= {f"{name}_learning_rate": 0.0 for name in STILL}
    options |= {"refine_intrinsics": True, "max_intrinsics_change": 0.08}
    config = tiny_config(steps, density={"stop_share": 0.0, "prune_opacity": 0.0}, **options)
    return train(
        Inputs(views, scene.truth, scene.extent),
        TrainingRun(config, folder, seed=3, threads=1),
    )


def test_training_recovers_wrong_intrinsics(scene: TinyScene, tmp_path: Path) -> None:
    result = trained(scene, tmp_path, 600)
    assert result.poses is None
    assert result.intrinsics is not None and list(result.intrinsics) == [0, 7]
    np.testing.assert_allclose(result.intrinsics[0], 0, atol=0.1 * np.abs(WRONG).max())
    np.testing.assert_allclose(result.intrinsics[7], -WRONG, atol=0.1 * np.abs(WRONG).max())


def test_refined_intrinsics_are_the_same_bits_after_a_kill(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = trained(scene, tmp_path / "whole", 100, refine_poses=True)
    with killed_in_step(monkeypatch, 61):
        trained(scene, tmp_path / "cut", 100, refine_poses=True)
    resumed = trained(scene, tmp_path / "cut", 100, refine_poses=True)
    assert whole.intrinsics is not None and resumed.intrinsics is not None
    assert whole.poses is not None and resumed.poses is not None
    for key, change in whole.intrinsics.items():
        np.testing.assert_array_equal(change, resumed.intrinsics[key])
        assert np.abs(change).max() > 0
    for name, pose in whole.poses.items():
        np.testing.assert_array_equal(pose, resumed.poses[name])
    for name, tensor in whole.gaussians.tensors().items():
        assert torch.equal(tensor, resumed.gaussians.tensors()[name]), name


def test_a_change_of_intrinsics_is_independent_of_the_image_size(scene: TinyScene) -> None:
    """Training also uses reduced images; the model holds cameras of the full size."""
    lenses = IntrinsicsRefinement.of([wrong(scene.views[0])], 0.02)
    lenses.change[0] = -WRONG
    view = wrong(scene.views[0])
    half = raster_camera(view, 2)
    found = lenses.camera(half, 0)
    true = raster_camera(scene.views[0], 2)
    for name in ("fx", "fy"):
        assert getattr(found, name) == pytest.approx(getattr(true, name), rel=1e-12)
    # The shift is in focal lengths of the lens as given, 3 % longer than the true one.
    assert found.cx == pytest.approx(true.cx, abs=0.04 * abs(half.cx - true.cx))
    assert found.cy == pytest.approx(true.cy, abs=0.04 * abs(half.cy - true.cy))
    size = view.width, view.height
    given = {
        3: Camera("SIMPLE_PINHOLE", *size, np.array([view.fx, view.cx, view.cy])),
        7: Camera("PINHOLE", *size, np.array([view.fx, view.fy, view.cx, view.cy])),
    }
    image = PosedImage("a", 7, np.eye(3), np.zeros(3))
    model = with_intrinsics(Reconstruction(given, {1: image}), {7: -WRONG})
    assert model.cameras[3] is given[3] and model.images == {1: image}
    assert model.cameras[7].pinhole[0] == pytest.approx(scene.views[0].fx, rel=1e-12)
    assert model.cameras[7].pinhole[2] == pytest.approx(scene.views[0].cx, abs=0.05)
    assert "0.9704 to 0.9704" in describe_intrinsics({7: -WRONG})
