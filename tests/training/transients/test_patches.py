"""A patch is transient if its residual is large, much larger than that of the other views on the
same surface, and if enough views show the surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.training.transients.evidence import Comparison, Expected
from pipeline.training.transients.patches import (
    MAX_CORRELATION,
    MAX_CORRELATION_AGAIN,
    MAX_SHARE,
    MIN_SUPPORT,
    confirmed,
    contradicted,
    correlation,
    widened,
)

SIZE = 90, 120
PERSON = np.zeros(SIZE, bool)
PERSON[30:60, 40:52] = True
NOTHING = np.zeros(SIZE, bool)


def expected(residual: float = 0.02, support: float = 1.0) -> Expected:
    return Expected(np.full(SIZE, residual, np.float32), np.full(SIZE, support, np.float32))


def residual(person: float = 0.2, elsewhere: float = 0.02) -> np.ndarray:
    return np.where(PERSON, person, elsewhere).astype(np.float32)


def compared(residuals: np.ndarray, edges: np.ndarray | None = None) -> Comparison:
    """A render of noise, beside a photograph of other noise, or of ``edges`` if they are given."""
    rng = np.random.default_rng(0)
    rendered, photo = rng.random((2, *residuals.shape)).astype(np.float16)
    return Comparison(residuals, rendered, photo if edges is None else rendered + edges)


def test_a_person_before_a_surface_that_others_agree_on_is_found() -> None:
    np.testing.assert_array_equal(contradicted(compared(residual()), expected(), NOTHING), PERSON)


@pytest.mark.parametrize(
    "found, others",
    [
        pytest.param(residual(0.2), expected(0.15), id="every view has it: foliage"),
        pytest.param(residual(0.2), expected(support=0.1), id="no other view shows it"),
        pytest.param(residual(0.06), expected(0.01), id="no core: a small difference of light"),
        pytest.param(residual(0.2, 0.2), expected(), id="the whole view: another exposure"),
    ],
)
def test_other_residuals_are_not(found: np.ndarray, others: Expected) -> None:
    assert not contradicted(compared(found), others, NOTHING).any()


def test_another_brightness_of_the_same_edges_is_not() -> None:
    """A reflection on a table moves with the camera, and leaves the edges where they are."""
    brighter = compared(residual(), edges=np.full(SIZE, 0.2, np.float16))
    assert not contradicted(brighter, expected(), NOTHING).any()


def test_a_patch_that_was_found_before_may_be_a_part_of_the_render_already() -> None:
    """Training copies people into the scene while nothing is left out yet."""
    view = compared(residual())
    copied = replace(view, rendered=view.rendered + np.float16(0.9) * view.photo)
    assert MAX_CORRELATION < correlation(copied, PERSON) < MAX_CORRELATION_AGAIN
    assert not contradicted(copied, expected(), NOTHING).any()
    np.testing.assert_array_equal(contradicted(copied, expected(), PERSON), PERSON)


def test_specks_are_not() -> None:
    speck = np.full(SIZE, 0.02, np.float32)
    speck[10:12, 10:13] = 0.4
    assert not contradicted(compared(speck), expected(), NOTHING).any()


def test_the_weaker_surroundings_of_a_core_belong_to_the_patch() -> None:
    found = residual(0.07)
    found[40:50, 44:48] = 0.3
    np.testing.assert_array_equal(contradicted(compared(found), expected(), NOTHING), PERSON)


def test_a_patch_must_have_been_found_before() -> None:
    other = np.zeros(SIZE, bool)
    other[70:80, 80:110] = True
    np.testing.assert_array_equal(confirmed(PERSON | other, PERSON), PERSON)
    assert not confirmed(PERSON, other).any()


def test_a_mask_has_no_holes_and_a_margin() -> None:
    ring = PERSON.copy()
    ring[40:45, 44:48] = False
    mask = widened(ring)
    assert mask[28:62, 38:54].all() and mask.sum() == 34 * 16


_PLANES = arrays(np.float32, (12, 16), elements=st.floats(0, 1, width=32))


@settings(max_examples=60, deadline=None)
@given(_PLANES, _PLANES, _PLANES)
def test_only_supported_pixels_and_no_large_part_of_a_view_are_found(
    found: np.ndarray, others: np.ndarray, support: np.ndarray
) -> None:
    mask = contradicted(compared(found), Expected(others, support), np.zeros((12, 16), bool))
    assert mask.mean() <= MAX_SHARE
    assert not (mask & (support <= MIN_SUPPORT)).any()
    assert not (confirmed(mask, mask) ^ mask).any()
