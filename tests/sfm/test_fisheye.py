"""Pairs of fisheye photographs are verified without a known focal length."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.geometry.cameras import Camera
from pipeline.geometry.rays import pixels
from pipeline.runtime.isolate import run_isolated
from pipeline.sfm.keypoints import Keypoints, keypoint_file

SIDE, FOCAL, COUNT = 800, 250.0, 400


def write_keypoints(folder: Path) -> None:
    """Four photographs of random points by a lens of 180 degrees."""
    rng = np.random.default_rng(0)
    lens = Camera(
        "OPENCV_FISHEYE", SIDE, SIDE, np.array([FOCAL, FOCAL, SIDE / 2, SIDE / 2, 0, 0, 0, 0])
    )
    points = rng.uniform((-3, -3, 0.5), (3, 3, 3), (COUNT, 3))
    descriptors = rng.integers(0, 60, (COUNT, 128)).astype(np.uint8)
    folder.mkdir()
    for number in range(4):
        turn = np.radians(8 * number)
        rotation = np.array(
            [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        )
        xy = pixels(lens, (points - [0.3 * number, 0, 0]) @ rotation.T)
        ones = np.ones(COUNT, np.float32)
        found = Keypoints(
            (xy + rng.normal(0, 0.3, xy.shape)).astype(np.float32),
            ones,
            ones,
            descriptors,
            np.zeros((COUNT, 3), np.uint8),
        )
        found.write(keypoint_file(folder, f"{number}.jpg"))


def verified(folder: Path) -> tuple[float, dict[tuple[str, str], int]]:
    """The initial focal length over the longer side, and the inliers of each pair."""
    import pycolmap

    from pipeline.sfm.database import MatchingInputs, build_database, verified_inliers
    from pipeline.sfm.fisheye import set_initial_focals
    from pipeline.sfm.models import quiet_colmap

    quiet_colmap()
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 0.5 * SIDE, SIDE, SIDE)
    images = [(i + 1, f"{i}.jpg", 1) for i in range(4)]
    pairs = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    path = folder / "database.db"
    inputs = MatchingInputs([camera], images, folder / "features", 0.8, 15, 0)
    set_initial_focals(inputs, pairs)
    build_database(path, inputs, pairs)
    with pycolmap.Database.open(path) as database:
        assert not any(c.has_prior_focal_length for c in database.read_all_cameras())
    return float(camera.mean_focal_length()) / SIDE, verified_inliers(path)


def test_the_focal_length_with_the_most_inliers_is_near_the_true_one(tmp_path: Path) -> None:
    write_keypoints(tmp_path / "features")
    focal, inliers = run_isolated(verified, tmp_path)
    assert 0.8 < focal / (FOCAL / SIDE) < 1.25
    assert len(inliers) == 6 and min(inliers.values()) > 0.6 * COUNT
