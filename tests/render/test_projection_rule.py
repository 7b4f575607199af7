"""What is drawn is close to what rays see: Gaussians around, beside and behind the camera."""

from __future__ import annotations

import pytest
import torch

from benchmarks.projection import (
    Around,
    depth_sigmas,
    errors,
    gaussians_around,
    linearised,
    view,
)
from pipeline.render import Backend, RasterOptions
from pipeline.render.reference import MIN_DEPTH_SIGMAS
from tests.render.scenes import Scene

COUNT = 10_000
#: The largest mean error over the pixels of a view (``benchmarks.projection``) of what is drawn.
BOUND = 0.26


@pytest.fixture(scope="module")
def around() -> Around:
    return gaussians_around(COUNT)


def as_scene(around: Around) -> Scene:
    logits = torch.full((COUNT,), 3.2)
    floats = (t.float() for t in (around.means, around.log_scales, around.quats))
    return (*floats, logits, torch.zeros(COUNT, 1, 3))  # type: ignore[return-value]


def drawn_by(backend: Backend, around: Around) -> torch.Tensor:
    options = RasterOptions(sh_degree=0)
    return backend.forward(*as_scene(around), view(), options).radii > 0


def test_nothing_is_drawn_whose_error_exceeds_the_bound(
    any_backend: Backend, around: Around
) -> None:
    drawn = drawn_by(any_backend, around)
    error = errors(around, view(), linearised).error
    # Without a rule, errors are up to three times the bound: the table holds such Gaussians.
    assert error[around.means[:, 2] > 0.01].max() > 2 * BOUND
    assert error[drawn].max() < BOUND
    # All others are drawn, if they are in the view.
    sure = (depth_sigmas(around) / MIN_DEPTH_SIGMAS - 1).abs() > 1e-5
    in_front = (around.means[:, 2] > 0.01) & (depth_sigmas(around) > MIN_DEPTH_SIGMAS)
    seen = errors(around, view(), linearised).drawn > 0
    assert torch.equal(drawn[sure & seen], in_front[sure & seen])
