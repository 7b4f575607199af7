"""Vignetting, slopes and trusted gains: known light is recovered from constructed observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.photos.exposure import GAMMA, Observations
from pipeline.photos.shading import (
    Light,
    Parts,
    choose_parts,
    fit_light,
    is_trusted,
    no_light,
    trusted,
)

PHOTOS, POINTS = 16, 500


def observations(light: Light | None = None, *, noise: float = 0.05, seed: int = 0) -> Observations:
    """Points at random positions of images by two cameras."""
    rng = np.random.default_rng(seed)
    shown = rng.random((PHOTOS, POINTS)) < 0.5
    view, point = np.nonzero(shown)
    position = rng.uniform((-0.8, -0.6), (0.8, 0.6), (len(view), 2))
    seen = Observations(
        point,
        view,
        position,
        rng.normal(-1, 0.3, (POINTS, 3))[point] + rng.normal(0, noise, (len(view), 3)),
        np.arange(PHOTOS),
        np.arange(PHOTOS) % 2,
        in_parts=False,
    )
    if light is None:
        return seen
    added = light.gains[seen.photo] + light.shading(seen)[:, None]
    return replace(seen, y=seen.y + added)


def lit(*, gains: float = 0.0, slopes: float = 0.0) -> Light:
    """The second camera has a vignetting of one stop, photographs differ by so many stops."""
    rng = np.random.default_rng(7)
    same = no_light(observations())
    shown = rng.normal(0, gains / GAMMA, (PHOTOS, 3))
    ramps = rng.normal(0, slopes / GAMMA, (PHOTOS, 2))
    return replace(
        same,
        gains=shown - shown.mean(axis=0),
        vignetting=np.array([[0.0, 0.0], [-0.3, 0.3 - 1 / GAMMA]]),
        slopes=ramps - ramps.mean(axis=0),
    )


def test_known_light_is_recovered() -> None:
    true = lit(gains=0.5, slopes=0.3)
    found = fit_light(observations(true), Parts(vignetting=True, slopes=True))
    np.testing.assert_allclose(found.gains, true.gains, atol=0.03)
    np.testing.assert_allclose(found.slopes, true.slopes, atol=0.03)
    np.testing.assert_allclose(found.vignetting.sum(axis=1), [0, -1 / GAMMA], atol=0.03)
    assert found.vignetting_stops == pytest.approx(1, abs=0.06)


def test_parts_are_chosen_where_the_photographs_have_them() -> None:
    assert choose_parts(observations()) == Parts()
    assert choose_parts(observations(lit())) == Parts(vignetting=True)
    assert choose_parts(observations(lit(slopes=0.4))) == Parts(vignetting=True, slopes=True)
    level = replace(lit(slopes=0.4), vignetting=np.zeros((2, 2)))
    assert choose_parts(observations(level)) == Parts(slopes=True)


def test_parts_of_photographs_have_no_lens() -> None:
    assert choose_parts(replace(observations(lit()), in_parts=True)) == Parts()


def test_outliers_do_not_bend_the_vignetting() -> None:
    seen = observations(lit())
    wrong = np.random.default_rng(1).random(len(seen.point)) < 0.1
    y = np.where(wrong[:, None], np.random.default_rng(2).uniform(-4, 0, seen.y.shape), seen.y)
    found = fit_light(replace(seen, y=y), Parts(vignetting=True))
    assert found.vignetting_stops == pytest.approx(1, abs=0.15)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 3), st.floats(-3, 3))
def test_vignetting_darkens_outwards_for_any_colours(seed: int, noise: float, rise: float) -> None:
    seen = observations(noise=noise, seed=seed)
    squared = np.square(seen.position).sum(axis=1, keepdims=True)
    found = fit_light(replace(seen, y=seen.y + rise * squared), Parts(vignetting=True))
    radius = np.linspace(0, 1, 20) ** 2
    for first, second in found.vignetting:
        values = first * radius + second * radius**2
        assert (np.diff(values) <= 1e-9).all() and values[-1] >= -2.001


def test_gains_are_kept_where_halves_agree() -> None:
    true = replace(no_light(observations()), gains=lit(gains=0.5).gains)
    seen = observations(true)
    fitted = fit_light(seen, Parts())
    np.testing.assert_allclose(trusted(seen, fitted).gains, true.gains, atol=0.03)
    assert is_trusted(seen, fitted)


def test_a_gain_of_one_half_of_the_image_is_dropped() -> None:
    """Something else than exposure: only the right half of photograph 0 is brighter."""
    seen = observations()
    right = (seen.photo == 0) & (seen.position[:, 0] > 0.05)
    seen = replace(seen, y=seen.y + 0.5 * right[:, None])
    fitted = fit_light(seen, Parts())
    assert np.linalg.norm(fitted.gains[0]) > 0.1
    assert np.linalg.norm(trusted(seen, fitted).gains[0]) < 0.3 * np.linalg.norm(fitted.gains[0])
    assert not is_trusted(seen, fitted)


def test_a_photograph_without_points_has_the_gain_of_its_camera() -> None:
    """The photographs of the second camera are all brighter."""
    gains = np.where(np.arange(PHOTOS)[:, None] % 2, 0.2, -0.2) * np.ones(3)
    seen = observations(replace(no_light(observations()), gains=gains))
    seen = seen.select(seen.photo != 3)
    found = trusted(seen, fit_light(seen, Parts()))
    np.testing.assert_allclose(found.gains[3], 0.2, atol=0.05)


def test_without_observations_nothing_is_known() -> None:
    none = observations().select(np.zeros(len(observations().point), bool))
    assert choose_parts(none) == Parts()
    assert not fit_light(none, Parts(vignetting=True, slopes=True)).slopes.any()
