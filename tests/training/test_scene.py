"""Inputs of the training of a scene, and the description of its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.config.settled import TrainOptions
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction
from pipeline.training import scene as stage
from pipeline.training.appearance.choose import AppearanceChoice
from pipeline.training.data.inputs import Inputs
from pipeline.training.data.known_depths import SCALE_SHARE, KnownDepths
from pipeline.training.run import TrainingRun
from tests.training.conftest import ball, camera_at


class Started(Exception):
    """Raised where training would begin."""


def test_the_scale_follows_the_depths_of_training_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not the extent of the cameras, along a street for example; test views have no influence."""
    views = [replace(camera_at(k), name=str(k), is_test=k == 0) for k in range(3)]
    known = KnownDepths(np.zeros((1, 2)), np.full(1, 4.0, np.float32), np.ones(1, np.float32))
    given: list[Inputs] = []

    def train(inputs: Inputs, *_: Any, **__: Any) -> None:
        given.append(inputs)
        raise Started

    def always(value: object) -> Callable[..., object]:
        return lambda *_, **__: value

    monkeypatch.setattr(stage, "train", train)
    monkeypatch.setattr(stage, "choose_appearance", always(AppearanceChoice()))
    monkeypatch.setattr(stage, "scene_extent", always(50.0))
    monkeypatch.setattr(stage, "point_depths", lambda training, _: [known] * len(training))
    with pytest.raises(Started):
        stage.train_scene(
            stage.SceneData(views, Manifest(scene="street", photos=()), Reconstruction({}, {})),
            ball(5, 0),
            TrainingRun(TrainOptions(), tmp_path),
        )
    assert [view.name for view in given[0].views] == ["1", "2"]
    assert given[0].extent == 50.0
    assert given[0].size == pytest.approx(SCALE_SHARE * 4.0)


def test_too_few_epochs_give_a_warning() -> None:
    assert stage.too_few_epochs(600, 200, 60.0, None) is None
    by_steps = stage.too_few_epochs(150, 200, 60.0, None)
    assert by_steps is not None and "150 steps are 0.8 epochs over 200 training views" in by_steps
    assert by_steps.endswith("raise train.steps")
    by_clock = stage.too_few_epochs(100, 200, 240.0, 4.0)
    assert by_clock is not None and "in 4 minutes at 2.4 s a step" in by_clock
    assert "raise train.budget_minutes" in by_clock
