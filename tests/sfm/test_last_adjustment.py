"""The last bundle adjustment: poses follow the accurate keypoints, and no outlier stays."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.io.colmap import read_model, write_model
from pipeline.metrics.pose import pose_error
from pipeline.runtime.isolate import run_isolated
from pipeline.scene.reconstruction import Reconstruction
from tests.sfm.test_refine import COUNT, truth

# The number of tracks that lose all but two observations, which the matches still have.
SHORT = 40


def _adjust(given: Path, out: Path) -> tuple[str, float]:
    import pycolmap

    from pipeline.sfm.last_adjustment import adjust_last
    from pipeline.sfm.models import write_model as write
    from pipeline.sfm.refine import bundle_adjust

    model = pycolmap.Reconstruction(given)
    _write_database(model, out / "database.db")
    for point_id in list(model.point3D_ids())[:SHORT]:
        track = model.point3D(point_id).track.elements
        for image_id, index in [(e.image_id, e.point2D_idx) for e in track[2:]]:
            model.delete_observation(image_id, index)
    bundle_adjust(model)
    write(model, out / "before")
    last, decision = adjust_last(model, out / "database.db", frozenset())
    write(last, out / "after")
    return decision, last.compute_mean_reprojection_error()


def _write_database(model: Any, path: Path) -> None:
    """The database of a model: its keypoints, and the matches of its tracks, but for those of the
    last photograph, which was placed without verified pairs; and a photograph without a pose."""
    import pycolmap

    with pycolmap.Database.open(path) as database:
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for image_id in sorted(model.reg_image_ids()):
            image = model.image(image_id)
            empty = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image_id)
            database.write_image(empty, use_image_id=True)
            keypoints = np.array([point.xy for point in image.points2D])
            database.write_keypoints(image_id, keypoints)
        left_out = pycolmap.Image(name="left_out.png", camera_id=1, image_id=COUNT + 1)
        database.write_image(left_out, use_image_id=True)
        database.write_keypoints(COUNT + 1, keypoints)
        pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for point_id in sorted(model.point3D_ids()):
            track = sorted(
                (element.image_id, element.point2D_idx)
                for element in model.point3D(point_id).track.elements
            )
            for (a, i), (b, j) in combinations(track, 2):
                pairs.setdefault((a, b if b < COUNT else COUNT + 1), []).append((i, j))
        for pair, matches in pairs.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = np.array(matches, np.uint32)
            database.write_two_view_geometry(*pair, geometry)


def adjusted(
    given: Reconstruction, folder: Path
) -> tuple[str, float, Reconstruction, Reconstruction]:
    write_model(folder / "given", given)
    decision, error = run_isolated(_adjust, folder / "given", folder)
    return decision, error, read_model(folder / "before"), read_model(folder / "after")


def with_tails(model: Reconstruction, share: float, whole: bool) -> Reconstruction:
    """A share of the observations, or of the tracks as a whole, get ten times the noise."""
    assert model.points is not None
    rng = np.random.default_rng(1)
    xy = model.points.track_xy.copy()
    chosen = rng.uniform(size=len(xy) // COUNT if whole else len(xy)) < share
    chosen = np.repeat(chosen, COUNT) if whole else chosen
    xy[chosen] += rng.normal(0, 1.0, (int(chosen.sum()), 2))
    return replace(model, points=replace(model.points, track_xy=xy))


@pytest.mark.parametrize(
    ("share", "whole", "ratio"), [(0.0, False, 1.3), (0.3, False, 0.7), (0.4, True, 0.5)]
)
def test_accurate_keypoints_decide(tmp_path: Path, share: float, whole: bool, ratio: float) -> None:
    right = truth(np.zeros(2), 0.1)
    decision, error, before, after = adjusted(with_tails(right, share, whole), tmp_path)
    errors = [pose_error(model, right).centre_median for model in (before, after)]
    assert errors[1] < ratio * errors[0], (errors, decision)
    assert error < 1 and "Cauchy loss" in decision
    assert before.points is not None and after.points is not None
    # Tracks with large residuals are kept, and short ones are continued.
    assert len(after.points.xyz) > 0.98 * len(before.points.xyz)
    if not share:
        assert len(after.points.track_xy) > len(before.points.track_xy) + 0.5 * SHORT * (COUNT - 2)


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
