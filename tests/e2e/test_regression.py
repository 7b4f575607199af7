"""The tiny scene gives what it gave: quality, poses, Gaussians, and the stages that ran."""

from __future__ import annotations

import copy
import json

import pytest

from tests.e2e.expectations import EXACT, FILE, MEASURED, UPDATE, differences, observe


@pytest.fixture(scope="module")
def expected() -> dict:
    return json.loads(FILE.read_text())


@pytest.mark.slow
def test_the_tiny_scene_gives_what_is_stored(finished, expected):
    said = differences(observe(finished, "tiny"), expected)
    assert not said, (
        "\n".join(said) + f"\nIf this is meant: {UPDATE}, and say in the commit what changed it."
    )


def test_a_change_is_told_with_its_size_and_direction(expected):
    """The comparison itself: within the tolerance silent, beyond it in both directions not."""
    assert set(expected["measured"]) == set(MEASURED) and set(expected["exact"]) == set(EXACT)
    stored = expected["measured"]
    same = copy.deepcopy(expected["exact"]) | {n: v["expected"] for n, v in stored.items()}
    assert differences(same, expected) == []
    nearly = same | {n: v["expected"] - 0.99 * v["tolerance"] for n, v in stored.items()}
    assert differences(nearly, expected) == []
    psnr = stored["psnr_db"]
    (worse,) = differences(same | {"psnr_db": psnr["expected"] - 2.0}, expected)
    assert "psnr_db" in worse and "2 below" in worse
    (better,) = differences(same | {"psnr_db": psnr["expected"] + 2.0}, expected)
    assert "2 above" in better
    (fewer,) = differences(same | {"stages": same["stages"][1:]}, expected)
    assert fewer.startswith("stages")


def test_tolerances_are_those_of_the_seeds(expected):
    """Nobody widens a tolerance by hand: it follows from the stored values of the seeds."""
    import statistics

    for name, stored in expected["measured"].items():
        scatter = 3 * statistics.stdev(stored["seeds"])
        assert stored["tolerance"] == pytest.approx(max(scatter, MEASURED[name]), rel=1e-3), name
        assert stored["expected"] == pytest.approx(statistics.mean(stored["seeds"]), rel=1e-4)
