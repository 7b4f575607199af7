"""Floaters close to a single camera are found and removed; no other Gaussians are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.config.settled import TrainOptions
from pipeline.render import RasterOptions
from pipeline.render.views import raster_camera
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.inputs import Inputs
from pipeline.training.data.known_depths import KnownDepths
from pipeline.training.density import floaters as floaters_module
from pipeline.training.density.floaters import MIN_POINTS, empty_depths, floaters
from pipeline.training.density.reduced_views import ReducedViews
from pipeline.training.loop.result import TrainResult
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from tests.training.conftest import TinyScene, killed_in_step, tiny_config

EMPTY = 1.0


@pytest.fixture(autouse=True)
def removal_in_short_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(floaters_module, "MIN_EPOCHS", 7)


def with_close(scene: TinyScene, distance: float, views: tuple[int, ...] = (0,)) -> Gaussians:
    """The scene, followed by a small Gaussian close to each of these cameras."""
    first, all_of = scene.initial, []
    for view in (scene.views[i] for i in views):
        floater = first.select(torch.tensor([0]))
        ahead = view.world_to_camera[2, :3]
        floater.means[:] = torch.from_numpy(view.centre + distance * ahead)
        floater.log_scales.fill_(np.log(0.02))
        floater.opacity_logits.fill_(2.0)
        all_of.append(floater)
    parts = [first, *all_of]
    joined = {name: torch.cat([part.tensors()[name] for part in parts]) for name in first.tensors()}
    return Gaussians(**joined)


def found(scene: TinyScene, gaussians: Gaussians, depth: float) -> list[int]:
    cameras = [raster_camera(view) for view in scene.views]
    views = ReducedViews(cameras, RasterOptions(sh_degree=0, threads=1))
    flags = floaters(gaussians, views, np.full(len(cameras), depth))
    return torch.nonzero(flags)[:, 0].tolist()


def test_a_gaussian_close_to_one_camera_is_a_floater(scene: TinyScene) -> None:
    last = len(scene.initial)
    assert found(scene, with_close(scene, 0.4), EMPTY) == [last]
    assert found(scene, with_close(scene, 0.4, (1, 4)), EMPTY) == [last, last + 1]


def test_gaussians_beyond_the_empty_space_or_without_points_are_no_floaters(
    scene: TinyScene,
) -> None:
    assert found(scene, with_close(scene, 1.1), EMPTY) == []
    assert found(scene, with_close(scene, 0.4), 0.0) == []


def test_a_gaussian_that_two_views_see_alike_is_no_floater(scene: TinyScene) -> None:
    """At any distance: the views agree on it."""
    twice = replace(scene, views=[*scene.views, scene.views[0]])
    assert found(twice, with_close(scene, 0.4), EMPTY) == []


def test_a_gaussian_that_only_a_hundredth_of_the_views_see_is_a_floater(
    scene: TinyScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neighbouring views with the same light can agree on it."""
    monkeypatch.setattr(floaters_module, "VIEWS_PER_FLOATER_VIEW", len(scene.views) // 2)
    last, other = len(scene.initial), scene.views[1:]
    twice = replace(scene, views=[*other, *[scene.views[0]] * 2])
    assert found(twice, with_close(scene, 0.4), EMPTY) == [last]
    assert found(twice, with_close(scene, 1.1), EMPTY) == []
    # Two of four have no more than half of it.
    often = replace(scene, views=[*other[2:], *[scene.views[0]] * 4])
    assert found(often, with_close(scene, 0.4), EMPTY) == []


def test_an_invisible_gaussian_is_no_floater(scene: TinyScene) -> None:
    faint = with_close(scene, 0.4)
    faint.opacity_logits[-1] = -9.0
    assert found(scene, faint, EMPTY) == []


def test_empty_space_ends_at_half_the_depth_of_the_nearest_points() -> None:
    def known(z: list[float]) -> KnownDepths:
        n = len(z)
        return KnownDepths(np.zeros((n, 2)), np.array(z, np.float32), np.ones(n, np.float32))

    many = known([0.1] + [4.0] * 99 + [9.0] * 100)
    few = known([4.0] * (MIN_POINTS - 1))
    np.testing.assert_allclose(empty_depths([many, few, known([])]), [2.0, 0.0, 0.0])


def run(
    scene: TinyScene, folder: Path, config: TrainOptions, first: Gaussians, threads: int = 1
) -> TrainResult:
    inputs = Inputs(scene.views, first, scene.extent, empty_depths=np.full(len(scene.views), EMPTY))
    return train(inputs, TrainingRun(config, folder, seed=3, threads=threads))


def nearest(scene: TinyScene, result: TrainResult) -> float:
    centre = torch.from_numpy(scene.views[0].centre).to(torch.float32)
    return float((result.gaussians.means - centre).norm(dim=1).min())


def test_training_removes_floaters(scene: TinyScene, tmp_path: Path) -> None:
    still = {"learning_rate_factor": 1e-9, "density": {"grad_threshold": 1e6}}
    first = with_close(scene, 0.4)
    result = run(scene, tmp_path / "a", tiny_config(60, **still), first)
    assert result.counters["floaters"] == 1
    assert nearest(scene, result) > EMPTY
    kept = tiny_config(
        60, **{**still, "density": {"grad_threshold": 1e6, "remove_floaters": False}}
    )
    result = run(scene, tmp_path / "b", kept, first)
    assert result.counters["floaters"] == 0
    assert nearest(scene, result) == pytest.approx(0.4, abs=1e-3)
    # Runs of few epochs do not remove floaters.
    short = 6 * len(scene.views)
    assert run(scene, tmp_path / "c", tiny_config(short, **still), first).counters["floaters"] == 0


@pytest.mark.parametrize("strategy", ["gradient", "mcmc"])
def test_killed_at_the_removal_of_floaters_and_resumed_gives_the_same_bits(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strategy: str
) -> None:
    config = tiny_config(60, density={"strategy": strategy})
    first = with_close(scene, 0.4)
    whole = run(scene, tmp_path / "whole", config, first)
    assert whole.counters["floaters"]
    for step in (18, 19, 54):  # the first and the last time
        folder = tmp_path / f"{step}"
        with killed_in_step(monkeypatch, step):
            run(scene, folder, config, first)
        resumed = run(scene, folder, config, first, threads=2)
        assert resumed.counters == whole.counters
        for name, tensor in whole.gaussians.tensors().items():
            assert torch.equal(tensor, resumed.gaussians.tensors()[name]), (step, name)
