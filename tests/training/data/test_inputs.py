"""Views are left out of the inputs of training with all that belongs to them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.scene.exposure import ViewLight
from pipeline.training.data.inputs import Inputs
from tests.training.conftest import ball, camera_at


@pytest.fixture
def inputs() -> Inputs:
    light = [ViewLight(gain=(value, value, value)) for value in np.arange(6.0).tolist()]
    views = [camera_at(0.5 * index) for index in range(6)]
    return Inputs(views, ball(10, 0), extent=1.0, light=light, empty_depths=np.arange(6.0))


def test_sampled_views_keep_their_gains_and_depths(inputs: Inputs) -> None:
    sampled = inputs.sampled(4, np.random.default_rng(0))
    assert sampled.light is not None and sampled.empty_depths is not None
    assert len(sampled.views) == 4 == len(set(sampled.empty_depths))
    for view, light, depth in zip(sampled.views, sampled.light, sampled.empty_depths, strict=True):
        assert view is inputs.views[int(depth)]
        assert light.gain == (depth,) * 3


def test_views_are_not_sampled_beyond_their_number(inputs: Inputs) -> None:
    assert inputs.sampled(7, np.random.default_rng(0)) is inputs
