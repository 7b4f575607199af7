"""One line says what was found in a scene folder."""

import pytest

from pipeline.io.posefiles import PoseSummary
from pipeline.plan.point_cloud import PointCloudFiles
from pipeline.plan.summary import found
from tests.plans import FACTS

POSES = PoseSummary(
    kind="colmap",
    path="sparse/0",
    num_images=12,
    models=("PINHOLE",),
    pinhole=True,
    num_points=0,
    tracked=0,
    centred=False,
)
CLOUD = PointCloudFiles(path="points.laz", files=("points.laz",), points=1234567, megabytes=9.5)


@pytest.mark.parametrize(
    "changes, chosen, line",
    [
        ({}, None, "20 photographs; poses: none"),
        (
            {"videos": 1, "video_frames": 412, "max_frames": 150, "photographs": 12},
            38,
            "1 video, 38 of 412 frames chosen; 12 photographs; poses: none",
        ),
        (
            {"videos": 2, "video_frames": 412, "max_frames": 150, "photographs": 0},
            None,
            "2 videos, at most 150 of 412 frames; poses: none",
        ),
        (
            {"linear": 3, "panoramas": 9, "masks": 20, "gps": 7, "given_poses": POSES},
            None,
            "20 photographs (3 RAW or EXR, 9 panoramas); masks: 20; GPS positions: 7; "
            "poses: COLMAP model sparse/0, 12 cameras",
        ),
        (
            {"point_cloud": CLOUD, "ground_control": True},
            None,
            "20 photographs; ground control points; point cloud: 1,234,567 points of points.laz; "
            "poses: none",
        ),
    ],
)
def test_a_line_says_what_was_found(changes, chosen, line):
    assert found(FACTS.model_copy(update=changes), chosen) == line
