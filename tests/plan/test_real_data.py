"""Scans and plans of real data sets, compared with known facts about them."""

import numpy as np
import pytest

from pipeline.config.schema import Config
from pipeline.plan.scan import Scan, scan
from tests import plans
from tests.plan.test_scan import given_model
from tests.plans import make_plan
from tests.tools import need_data


def look(name: str) -> Scan:
    return scan(need_data(name), name, Config(), cache=None)


@pytest.mark.parametrize(
    "name, count, skipped, pairs, share",
    [
        ("fox", 50, ["decode", "refine"], "retrieval", "group"),
        ("lund_door", 12, ["decode", "refine"], "exhaustive", "group"),
        ("liberty", 135, ["decode", "refine"], "retrieval", "image"),
        ("reichstag", 74, ["decode", "refine"], "retrieval", "image"),
        ("mip360_bonsai", 292, ["decode", "features", "matches", "sfm"], None, None),
        (
            "nerf_lego",
            100,
            ["decode", "features", "matches", "refine", "sfm", "undistort"],
            None,
            None,
        ),
    ],
)
def test_plans(name, count, skipped, pairs, share):
    seen = look(name)
    plan = make_plan(seen, Config())
    assert len(seen.photos) == count
    assert plans.skipped(plan) == skipped
    assert pairs in (None, plan.config.matches.pairs)
    assert share in (None, plan.config.sfm.share_cameras)


def test_exif_of_a_phone():
    seen = look("monstree")
    photo = seen.photos[0]
    assert "iPhone 7" in photo.camera_group and photo.gps is not None
    # 28 mm equivalent; the true focal length of this phone is 0.81 of the long side.
    assert photo.focal_px == pytest.approx(0.81 * 907, rel=0.01)
    assert {p.orientation for p in seen.photos} != {1}


def test_bonsai_points_have_small_reprojection_errors():
    seen = look("mip360_bonsai")
    model = given_model(seen).model
    assert len(model.images) == 292 and len(model.points) == 91_625
    assert float(np.mean(model.points.error)) < 1.0


def test_lego_cameras_look_at_the_model():
    model = given_model(look("nerf_lego")).model
    for image in model.images.values():
        # All cameras are on a sphere around the origin and look at it.
        ahead = image.rotation[2]
        towards = -image.centre / np.linalg.norm(image.centre)
        assert ahead @ towards > 0.99
