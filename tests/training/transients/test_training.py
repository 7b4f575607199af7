"""Training with something in one photograph that the others contradict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.scene.views import View
from pipeline.training.loop.result import TrainResult
from pipeline.training.scene import transients_lines
from pipeline.training.transients import search
from pipeline.training.transients.search import Transients
from tests.training.conftest import (
    CROWDED_VIEWS,
    PERSON,
    TinyScene,
    killed_in_step,
    person_error,
    tiny_config,
)
from tests.training.loop.test_trainer import assert_same, run

STEPS = 120


@pytest.fixture(autouse=True)
def short_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search in runs of few epochs."""
    monkeypatch.setattr(search, "MIN_EPOCHS", 5)


def trained(
    crowd: tuple[TinyScene, list[View]], folder: Path, transients: str, crowded: bool = True
) -> TrainResult:
    scene, views = crowd
    config = tiny_config(STEPS, transients=transients, density={"max_gaussians": 200})
    return run(scene, folder, config, views if crowded else scene.views)


def test_a_person_in_one_view_is_left_out_of_the_loss(crowd, tmp_path: Path) -> None:
    scene, views = crowd
    result = trained(crowd, tmp_path / "find", "find")
    assert result.transients is not None and "3.png" in result.transients
    mask = result.transients["3.png"]
    assert sum(int(other.sum()) for other in result.transients.values()) < 1.5 * mask.sum()
    assert mask.shape == (views[3].height, views[3].width)
    assert mask[PERSON].mean() > 0.9 and mask.sum() < 3 * mask[PERSON].size
    [line] = transients_lines(result, views)
    assert line.startswith("passers-by: ") and "of 10 views" in line
    assert "left out of the loss (train.transients)" in line
    without = trained(crowd, tmp_path / "none", "none")
    assert without.transients is None
    assert person_error(result, scene) < 0.5 * person_error(without, scene)


def test_a_static_scene_has_the_bits_of_a_run_without_the_search(crowd, tmp_path: Path) -> None:
    found = trained(crowd, tmp_path / "find", "find", crowded=False)
    assert found.transients == {} and not transients_lines(found, crowd[1])
    assert_same(found, trained(crowd, tmp_path / "none", "none", crowded=False))


@pytest.mark.parametrize("step", [20, 50])
def test_killed_between_searches_and_resumed_gives_the_same_bits(
    crowd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """The searches are after steps 14, 24 and 60; each has a backward pass for each view."""
    whole = trained(crowd, tmp_path / "whole", "find")
    searches = sum(step > round(share * STEPS) for share in search.RUN_SHARES)
    with killed_in_step(monkeypatch, step + searches * CROWDED_VIEWS):
        trained(crowd, tmp_path / "cut", "find")
    resumed = trained(crowd, tmp_path / "cut", "find")
    assert_same(whole, resumed)
    assert whole.transients is not None and resumed.transients is not None
    for name, mask in whole.transients.items():
        np.testing.assert_array_equal(mask, resumed.transients[name])


def test_few_views_are_not_searched(scene: TinyScene, tmp_path: Path) -> None:
    assert run(scene, tmp_path, tiny_config(60, transients="find")).transients is None


def test_masks_are_restored(crowd) -> None:
    views = crowd[1]
    before, rng = Transients.of(views, STEPS), np.random.default_rng(0)
    for masks in (before.found, before.masks):
        masks[:] = [rng.random(mask.shape) < 0.3 for mask in masks]
    after = Transients.of(views, STEPS)
    after.restore(before.arrays())
    for masks, expected in ((after.found, before.found), (after.masks, before.masks)):
        for mask, other in zip(masks, expected, strict=True):
            np.testing.assert_array_equal(mask, other)


def test_ghosts_before_the_square_are_made_transparent(
    crowd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Gaussian in front of one camera explains the square there, and nothing in other views."""
    scene, views = crowd
    view = views[3]
    initial = scene.initial.clone()
    ahead = torch.from_numpy(view.world_to_camera[2, :3].copy()).float()
    initial.means[0] = torch.from_numpy(view.centre.copy()).float() + 0.3 * ahead
    initial.log_scales[0] = -3.5
    initial.opacity_logits[0] = 2.0
    photographs_of = search.explaining
    seen = []

    def explaining(*args):
        found = photographs_of(*args)
        seen.append(int(found.sum()))
        return found

    monkeypatch.setattr(search, "explaining", explaining)
    planted = replace(scene, initial=initial), views
    result = trained(planted, tmp_path, "find")
    assert result.counters["ghosts"] == sum(seen) >= 1
