"""Embeddings before training separate lights, whatever the exposure and the tracks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.training.appearance.start import initial_embeddings
from tests.photos.test_disagreement import photographs

LIGHTS = [0, 1, 2] * 3
ONES = np.ones((9, 3))


def separation(found: np.ndarray, lights: list[int]) -> float:
    """The share of the variance that is between photographs of one light."""
    groups = [found[[i for i, other in enumerate(lights) if other == g]] for g in set(lights)]
    within = sum(float(((group - group.mean(0)) ** 2).sum()) for group in groups)
    return within / float(((found - found.mean(0)) ** 2).sum())


@pytest.mark.parametrize("tracks", ["all", "none"])
def test_lights_are_separated(tmp_path: Path, tracks: str) -> None:
    found = initial_embeddings(*photographs(tmp_path, LIGHTS, ONES, tracks=tracks), None, 3)
    assert found.shape == (9, 3) and np.abs(found.mean(0)).max() < 1e-9
    assert found[:, 0].std() == pytest.approx(1)
    assert found.std(0).tolist() == sorted(found.std(0).tolist(), reverse=True)
    assert separation(found, LIGHTS) < 0.02


def test_gains_take_the_exposure_out(tmp_path: Path) -> None:
    gains = 2.0 ** np.random.default_rng(1).uniform(-0.5, 0.5, (9, 3))
    scene = photographs(tmp_path, LIGHTS, gains)
    with_gains, without = (
        separation(initial_embeddings(*scene, given, 2), LIGHTS) for given in (gains, None)
    )
    assert with_gains < 0.5 * without


def test_lights_without_common_points_differ_by_their_whole_colours(tmp_path: Path) -> None:
    """The tracks of each light are its own, and the cameras move."""
    lights, gains = [0] * 3 + [1] * 3, np.array([[1.0] * 3] * 3 + [[0.3, 0.4, 0.6]] * 3)
    scene = photographs(tmp_path, lights, gains, tracks="light", shift=0.0055)
    assert separation(initial_embeddings(*scene, None, 2)[:, :1], lights) < 0.2


def test_equal_photographs_have_no_embedding(tmp_path: Path) -> None:
    found = initial_embeddings(*photographs(tmp_path, [0] * 4, ONES[:4]), None, 2)
    assert np.abs(found).max() < 1e-3
