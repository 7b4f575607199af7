"""Refinement recovers inaccurate poses, with and without the Gaussians."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.render import RasterOptions
from pipeline.scene.exposure import ViewLight
from pipeline.scene.views import View
from pipeline.training.cameras.fit_pose import fit_pose
from pipeline.training.cameras.poses import rigid, with_common_motion
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.result import TrainResult
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from tests.training.conftest import TinyScene, killed_in_step, tiny_config


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-5, 2e-4, 0.3, 3.0])
def test_a_rotation_is_the_matrix_exponential(size: float) -> None:
    turn = size * np.array([0.6, -0.48, 0.64])
    x, y, z = turn
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    found = rigid(turn, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(found[:3, :3], torch.linalg.matrix_exp(skew).numpy(), atol=1e-14)
    np.testing.assert_array_equal(found[:, 3], [1, 2, 3, 1])


def off(view: View, seed: int) -> View:
    """The view, rotated by about a degree and moved by a fiftieth of its distance."""
    rng = np.random.default_rng(seed)
    change = rigid(0.012 * rng.standard_normal(3), 0.03 * rng.standard_normal(3))
    return replace(view, world_to_camera=change @ view.world_to_camera)


def distance(a: View, b: View) -> float:
    """Sum of the rotation, radians, and the translation, extents."""
    cosine = (np.trace(a.world_to_camera[:3, :3] @ b.world_to_camera[:3, :3].T) - 1) / 2
    turned = float(np.arccos(np.clip(cosine, -1, 1)))
    return turned + float(np.linalg.norm(a.centre - b.centre)) / 3.0


@pytest.mark.parametrize("index", range(3))
def test_a_test_view_is_aligned_to_its_photograph(scene: TinyScene, index: int) -> None:
    view = scene.views[index]
    wrong = off(view, index)
    photo = np.asarray(Image.open(view.image))
    mask = np.ones(photo.shape[:2], bool)
    mask[:3] = False
    light = ViewLight(gain=(0.5, 1.0, 1.25), slope=(0.2, 0.1))
    seen = np.minimum(np.rint(photo * light.factor(view)), 255).astype(np.uint8)
    found = fit_pose(
        scene.truth, wrong, seen, mask, light, RasterOptions(1, threads=1), scene.extent, 0.2
    )
    assert distance(found, view) < 0.05 * distance(wrong, view)


def test_test_views_follow_the_common_motion_of_refined_cameras(scene: TinyScene) -> None:
    """The scene drifts as a whole: a rotation of the world and a translation."""
    drift = rigid(np.array([0.3, -0.2, 0.5]), np.array([5.0, -3.0, 1.0]))
    true = {view.name: view.world_to_camera @ np.linalg.inv(drift) for view in scene.views}
    held_out = {scene.views[0].name, scene.views[4].name}
    moved = {name: pose for name, pose in true.items() if name not in held_out}
    found = with_common_motion(scene.views, moved)
    assert list(found) == [view.name for view in scene.views]
    for name, pose in true.items():
        np.testing.assert_allclose(found[name], pose, atol=1e-12)
        if name not in held_out:
            assert found[name] is moved[name]


def trained(scene: TinyScene, folder: Path, threads: int = 1, **options: object) -> TrainResult:
    return train(
        Inputs(
            [off(view, number) for number, view in enumerate(scene.views)],
            scene.truth,
            scene.extent,
        ),
        TrainingRun(
            tiny_config(300, means_learning_rate=5e-3, **options), folder, seed=3, threads=threads
        ),
    )


def test_training_recovers_a_wrong_pose(scene: TinyScene, tmp_path: Path) -> None:
    """The other poses are correct, and the Gaussians are correct and fixed."""
    views = [off(scene.views[0], 5), *scene.views[1:]]
    still = ("means", "scales", "quats", "opacities", "sh0", "shN")
    options: dict[str, object] = {f"{name}_learning_rate": 0.0 for name in still}
    options |= {"refine_poses": True, "max_pose_change": 0.05}
    config = tiny_config(600, density={"stop_share": 0.0, "prune_opacity": 0.0}, **options)
    result = train(
        Inputs(views, scene.truth, scene.extent),
        TrainingRun(config, tmp_path, seed=3, threads=1),
    )
    assert result.poses is not None and list(result.poses) == [view.name for view in views]
    moved = [replace(view, world_to_camera=result.poses[view.name]) for view in views]
    for found, true in zip(moved, scene.views, strict=True):
        assert distance(found, true) < 0.1 * distance(views[0], scene.views[0])


def test_refined_poses_are_the_same_bits_after_a_kill(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = trained(scene, tmp_path / "whole", threads=2, refine_poses=True)
    with killed_in_step(monkeypatch, 137):
        trained(scene, tmp_path / "cut", refine_poses=True)
    resumed = trained(scene, tmp_path / "cut", refine_poses=True)
    assert whole.poses is not None and resumed.poses is not None
    for name, pose in whole.poses.items():
        np.testing.assert_array_equal(pose, resumed.poses[name])
    for name, tensor in whole.gaussians.tensors().items():
        assert torch.equal(tensor, resumed.gaussians.tensors()[name]), name
