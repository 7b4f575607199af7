"""The quality check on synthetic captures: no wrong model is good, no correct one has failed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.runtime.isolate import run_isolated
from pipeline.sfm.judge import judge
from tests.counters import GOOD as GOOD_EVIDENCE

# Fast cases; all of them: python -m benchmarks.judge.
GOOD = ("three_views", "prior_x3.0", "duplicates")
WEAK = ("outliers_30",)
FAILED = ("turning", "one_photo_8_times")
# Folded or bent models that register every photograph at a small reprojection error.
WRONG_BUT_COMPLETE = ("tower_4_bare", "windows")


def judged(case: str, seed: int, folder: Path) -> dict:
    """True grade, verdict, reasons and evidence of the first mapping attempt of a case."""
    from benchmarks.judge.__main__ import run_made
    from pipeline.sfm.models import quiet_colmap

    quiet_colmap()
    row = run_made(case, seed, "incremental", 1, folder)
    assert row.truth is not None
    return {
        "truth": row.truth.grade,
        "share": row.truth.share,
        "verdict": row.verdict,
        "reasons": "; ".join(row.reasons),
        "evidence": row.evidence,
    }


@pytest.mark.parametrize("case", GOOD)
def test_correct_models_are_good(case, tmp_path):
    row = run_isolated(judged, case, 0, tmp_path)
    assert row["truth"] == "good" and row["verdict"] == "good", row


@pytest.mark.parametrize("case", WEAK)
def test_correct_but_incomplete_models_are_weak(case, tmp_path):
    row = run_isolated(judged, case, 0, tmp_path)
    assert row["share"] == 1 and row["truth"] == "weak" and row["verdict"] == "weak", row


@pytest.mark.parametrize("case", FAILED)
def test_wrong_models_are_failed(case, tmp_path):
    row = run_isolated(judged, case, 0, tmp_path)
    assert row["truth"] == "failed" and row["verdict"] == "failed", row


@pytest.mark.slow
@pytest.mark.parametrize("case", WRONG_BUT_COMPLETE)
def test_wrong_models_that_register_all_images_are_failed(case, tmp_path):
    row = run_isolated(judged, case, 0, tmp_path)
    evidence = row["evidence"]
    assert evidence["registered"] == evidence["total"] and evidence["reprojection_px"] < 0.6, row
    assert row["truth"] == "failed" and row["verdict"] == "failed", row
    assert "look alike" in row["reasons"]


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, "good"),
        ({"missing_covisibility": 0.25}, "good"),
        ({"missing_covisibility": 0.25, "agreeing_distinctive": 0.99}, "weak"),
        ({"missing_covisibility": 0.25, "agreeing_pairs": 0.99}, "weak"),
        ({"missing_covisibility": 0.32}, "weak"),
        ({"missing_covisibility": 0.36}, "failed"),
        ({"missing_covisibility": 0.25, "pairs_left_out": True}, "weak"),
        ({"missing_covisibility": 0.18, "pairs_left_out": True}, "good"),
        ({"agreeing_distinctive": 0.97}, "weak"),
        ({"agreeing_distinctive": 0.97, "pairs_left_out": True}, "failed"),
        ({"agreeing_distinctive": 0.95}, "failed"),
        ({"broken_steps": 1}, "failed"),
    ],
)
def test_signs_of_a_fold_decide(changed, expected):
    """Missing covisibility alone is weaker evidence than pairs that contradict the model."""
    assert judge(GOOD_EVIDENCE.model_copy(update=changed), 0.5).grade == expected


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        # A plane: the cost rises little, but by more than its noise.
        ({"focal_off": None, "focal_certainty": 0.01}, "good"),
        # As little, with few residuals; and almost nothing.
        ({"focal_off": None, "focal_certainty": 0.01, "observations_per_image": 330}, "weak"),
        ({"focal_off": None, "focal_certainty": 0.001}, "weak"),
        # At the focal length of EXIF the cost would rise much, or little.
        ({"focal_off": 3.0, "focal_certainty": 0.01}, "good"),
        ({"focal_off": 1.4, "focal_certainty": 0.01}, "weak"),
        # EXIF is wrong: the model is not the best one near it, or its distortion makes up for it.
        ({"focal_off": 1.05, "focal_certainty": 0.0}, "weak"),
        ({"focal_off": 1.02, "focal_certainty": None, "pincushion": 1.4}, "weak"),
        # A camera that turned by hand, and one with a short baseline.
        ({"parallax": 0.0025, "median_angle_deg": 8.0}, "failed"),
        ({"parallax": 0.005, "median_angle_deg": 2.5}, "good"),
    ],
)
def test_focal_lengths_and_depths_must_be_determined(changed, expected):
    assert judge(GOOD_EVIDENCE.model_copy(update=changed), 0.5).grade == expected


def test_the_benchmark_aligns_a_model_by_the_majority_of_its_views():
    """A part of the views is rotated by 180 degrees: a least squares alignment would be off for
    all of them."""
    from benchmarks.judge.truth import grade
    from pipeline.geometry.cameras import Camera
    from pipeline.scene.reconstruction import PosedImage, Reconstruction

    rng = np.random.default_rng(0)
    camera = Camera("SIMPLE_PINHOLE", 100, 100, np.array([90.0, 50, 50]))

    def model(poses: list[tuple[np.ndarray, np.ndarray]]) -> Reconstruction:
        images = {
            i: PosedImage(f"{i}.jpg", 1, rotation, -rotation @ centre)
            for i, (rotation, centre) in enumerate(poses, start=1)
        }
        return Reconstruction({1: camera}, images)

    true = []
    for angle in np.linspace(0, 2 * np.pi, 20, endpoint=False):
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[-s, c, 0], [0, 0, -1], [-c, -s, 0]])
        true.append((rotation, np.array([3 * c, 3 * s, rng.uniform(-0.3, 0.3)])))
    half_turn = np.diag([-1.0, -1.0, 1.0])
    folded = [
        (r @ half_turn, half_turn @ c) if i >= 14 else (r, c) for i, (r, c) in enumerate(true)
    ]
    # The same model in another frame.
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    moved = [(r @ turn.T, 0.2 * turn @ c + 7) for r, c in folded]
    found = grade(model(moved), [model(true)], 20)
    assert found.share == pytest.approx(0.7) and found.grade == "weak"
    assert grade(model(moved[:14]), [model(true)], 17).grade == "good"
    assert grade(model(moved[:14]), [model(true)], 20).grade == "weak"
    assert grade(model(moved[:9]), [model(true)], 20).grade == "failed"
    assert grade(None, [model(true)], 20).grade == "failed"
