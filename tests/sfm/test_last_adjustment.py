"""The last bundle adjustment: poses follow the accurate keypoints, and no outlier stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.io.colmap import read_model, write_model
from pipeline.metrics.pose import pose_error
from pipeline.runtime.isolate import run_isolated
from pipeline.scene.reconstruction import Reconstruction
from tests.sfm.test_refine import COUNT, truth


def _adjust(given: Path, out: Path) -> tuple[str, float]:
    import pycolmap

    from pipeline.sfm.last_adjustment import adjust_last
    from pipeline.sfm.models import write_model as write
    from pipeline.sfm.refine import bundle_adjust

    model = pycolmap.Reconstruction(given)
    bundle_adjust(model)
    write(model, out / "before")
    last, decision = adjust_last(model, frozenset())
    write(last, out / "after")
    return decision, last.compute_mean_reprojection_error()


def adjusted(
    given: Reconstruction, folder: Path
) -> tuple[str, float, Reconstruction, Reconstruction]:
    write_model(folder / "given", given)
    decision, error = run_isolated(_adjust, folder / "given", folder)
    return decision, error, read_model(folder / "before"), read_model(folder / "after")


def with_tails(model: Reconstruction, share: float) -> Reconstruction:
    """A share of the observations get ten times the noise of the others."""
    assert model.points is not None
    rng = np.random.default_rng(1)
    xy = model.points.track_xy.copy()
    chosen = rng.uniform(size=len(xy)) < share
    xy[chosen] += rng.normal(0, 1.0, (int(chosen.sum()), 2))
    return replace(model, points=replace(model.points, track_xy=xy))


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_accurate_keypoints_decide(tmp_path: Path, share: float) -> None:
    right = truth(np.zeros(2), 0.1)
    decision, error, before, after = adjusted(with_tails(right, share), tmp_path)
    errors = [pose_error(model, right).centre_median for model in (before, after)]
    assert errors[1] < (0.7 if share else 1.3) * errors[0], (errors, decision)
    assert error < 1 and "Cauchy loss" in decision


def test_a_point_behind_a_camera_is_removed(tmp_path: Path) -> None:
    """Its reprojection error is the largest number there is, and was the mean of the model."""
    model = truth(np.zeros(2), 0.1)
    assert model.points is not None
    first = next(iter(model.images.values()))
    xyz = model.points.xyz.copy()
    xyz[0] = first.centre - 0.2 * first.rotation[2]
    _, error, _, after = adjusted(replace(model, points=replace(model.points, xyz=xyz)), tmp_path)
    assert error < 0.5
    assert after.points is not None and len(after.images) == COUNT
