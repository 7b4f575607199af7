"""Stated standard deviations are those of poses: errors against the truth over them are about 1."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.io.colmap import read_model, write_model
from pipeline.metrics.pose import align_poses
from pipeline.runtime.isolate import run_isolated
from pipeline.scene.reconstruction import Reconstruction
from pipeline.sfm.judge import Verdict
from pipeline.sfm.keypoint_variance import COMMON_ERRORS
from pipeline.sfm.uncertain import MAX_BASELINE_SHARE, with_uncertainty
from pipeline.sfm.uncertainty_file import PoseUncertainty, Uncertainty
from tests.sfm.test_refine import OFF, truth

NOISE_PX = 0.3


def _estimate(given: Path, out: Path, free: bool) -> Any:
    import pycolmap

    from pipeline.sfm.keypoint_variance import loss_scale
    from pipeline.sfm.models import quiet_colmap
    from pipeline.sfm.models import write_model as write
    from pipeline.sfm.refine import bundle_adjust
    from pipeline.sfm.uncertainty import estimate_uncertainty

    quiet_colmap()
    model = pycolmap.Reconstruction(given)
    bundle_adjust(model)
    bundle_adjust(model, {1} if free else frozenset(), loss_px=loss_scale(model))
    write(model, out)
    return estimate_uncertainty(model, {})


def estimated(given: Reconstruction, folder: Path, free: bool) -> tuple[Uncertainty, Any]:
    write_model(folder / "given", given)
    found = run_isolated(_estimate, folder / "given", folder / "out", free)
    return found, read_model(folder / "out")


def moved(model: Reconstruction, scale: float, shift: float) -> Reconstruction:
    """The model at another scale and origin."""
    assert model.points is not None
    images = {
        i: replace(image, translation=scale * image.translation - image.rotation @ [shift, 0, 0])
        for i, image in model.images.items()
    }
    points = replace(model.points, xyz=scale * model.points.xyz + [shift, 0, 0])
    return replace(model, images=images, points=points)


@pytest.mark.parametrize("off", [np.zeros(2), OFF])
def test_errors_are_as_large_as_stated(tmp_path: Path, off: np.ndarray) -> None:
    right = truth(off, NOISE_PX)
    found, model = estimated(right, tmp_path, bool(off.any()))
    names = sorted(found.photographs)
    pairs = [(model.by_name()[name], right.by_name()[name]) for name in names]
    arrays = [
        np.stack([getattr(p[k], a) for p in pairs]) for k in (0, 1) for a in ("rotation", "centre")
    ]
    aligned = align_poses(*arrays)
    errors = np.linalg.norm(aligned(arrays[1]) - arrays[3], axis=1)
    # Independent noise lacks the common errors of real keypoints. The norm of three errors is up to
    # 1.5 times the largest deviation.
    stated = np.array([found.photographs[name].centre for name in names]) / COMMON_ERRORS
    assert 0.4 < np.median(errors / stated) < 1.6
    focal = abs(model.cameras[1].params[0] / right.cameras[1].params[0] - 1)
    assert 100 * focal < 3 * found.focal_percent[1] / COMMON_ERRORS
    # A principal point that is free makes directions less certain.
    assert found.photographs[names[0]].direction_deg > (0.02 if off.any() else 0)


def test_shares_depend_on_neither_scale_nor_origin(tmp_path: Path) -> None:
    right = truth(np.zeros(2), NOISE_PX)
    (tmp_path / "far").mkdir()
    found, _ = estimated(right, tmp_path, False)
    far, _ = estimated(moved(right, 40.0, 300.0), tmp_path / "far", False)
    for name, pose in found.photographs.items():
        other = far.photographs[name]
        assert other.baseline_share == pytest.approx(pose.baseline_share, rel=0.02)
        assert other.centre == pytest.approx(40 * pose.centre, rel=0.05)


def stated(shares: list[float]) -> Uncertainty:
    return Uncertainty(
        photographs={
            f"{i}.png": PoseUncertainty(centre=share, baseline_share=share, direction_deg=0.1)
            for i, share in enumerate(shares)
        },
        focal_percent={1: 0.1},
    )


@pytest.mark.parametrize(
    ("shares", "grade", "text"),
    [
        ([0.001] * 10, "good", None),
        ([0.001] * 9 + [0.5], "good", "9.png"),
        ([0.5] * 10, "weak", "0.png"),
    ],
)
def test_a_model_of_uncertain_photographs_is_weak(shares, grade, text) -> None:
    summary = stated(shares).summary(MAX_BASELINE_SHARE)
    verdict, warnings = with_uncertainty(Verdict("good", [], [], False), summary, len(shares))
    assert verdict.grade == grade
    told = [*warnings, *verdict.reasons]
    assert (text in told[0]) if text else not told
