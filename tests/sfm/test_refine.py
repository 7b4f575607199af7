"""Known poses are refined if freeing the principal point lowers the cost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.config.settled import Sfm
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import read_model, write_model
from pipeline.metrics.pose import pose_error
from pipeline.runtime.isolate import run_isolated
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from tests.sfm import corner
from tests.sfm.jobs import digests

COUNT, POINTS = 16, 250
# Offset of the principal point from the image centre, pixels (1.5 and 1 per cent of the longer
# side, as in common phones).
OFF = np.array([-6.0, 4.0])


def roll(degrees: float) -> np.ndarray:
    """Rotation about the optical axis: different rolls distinguish an offset principal point from
    a rotated camera."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def truth(off: np.ndarray, noise_px: float, points: int = POINTS) -> Reconstruction:
    """Cameras on an arc that observe all points, with Gaussian noise on the observations."""
    rng = np.random.default_rng(0)
    params = np.array([corner.FOCAL, corner.WIDTH / 2 + off[0], corner.HEIGHT / 2 + off[1], 0.0])
    images = {}
    for i, (rotation, translation) in enumerate(corner.poses(COUNT), start=1):
        about_axis = roll(30 * (-1) ** i)
        images[i] = PosedImage(f"{i:02d}.png", 1, about_axis @ rotation, about_axis @ translation)
    xyz = rng.uniform(0, 0.8, (points, 3)) * (1, -1, -1)
    seen = []
    for image in images.values():
        local = xyz @ image.rotation.T + image.translation
        seen.append(params[0] * local[:, :2] / local[:, 2:] + params[1:3])
    pixels = np.stack(seen, axis=1) + rng.normal(0, noise_px, (points, COUNT, 2))
    cloud = Points(
        xyz,
        np.zeros((points, 3), np.uint8),
        np.zeros(points),
        np.arange(points + 1) * COUNT,
        np.tile(np.arange(1, COUNT + 1), points),
        pixels.reshape(-1, 2),
    )
    camera = Camera("SIMPLE_RADIAL", corner.WIDTH, corner.HEIGHT, params)
    return Reconstruction({1: camera}, images, cloud)


def with_central_principal_point(model: Reconstruction) -> Reconstruction:
    camera = model.cameras[1]
    params = camera.params.copy()
    params[1:3] = camera.width / 2, camera.height / 2
    return replace(model, cameras={1: replace(camera, params=params)})


def refined(given: Reconstruction, folder: Path, **options: Any) -> tuple[Any, Reconstruction]:
    write_model(folder / "given", given)
    report = run_isolated(_refine, folder / "given", Sfm.model_validate(options), folder / "out")
    return report, read_model(folder / "out")


def _refine(sparse: Path, config: Sfm, out: Path) -> Any:
    from pipeline.sfm.known_poses import refine_known_poses, write_adjusted

    model, report = refine_known_poses(sparse, config)
    write_adjusted(model, sparse, out)
    return report


@pytest.fixture(scope="module")
def biased(tmp_path_factory) -> Reconstruction:
    """A model adjusted with the principal point fixed at the image centre: poses and points
    compensate for its offset."""
    folder = tmp_path_factory.mktemp("biased")
    write_model(folder / "initial", with_central_principal_point(truth(OFF, 0.3)))
    run_isolated(_adjust_fixed, folder / "initial", folder / "fixed")
    return read_model(folder / "fixed")


def _adjust_fixed(sparse: Path, out: Path) -> None:
    import pycolmap

    from pipeline.sfm.models import quiet_colmap
    from pipeline.sfm.models import write_model as write
    from pipeline.sfm.refine import bundle_adjust

    quiet_colmap()
    model = pycolmap.Reconstruction(sparse)
    bundle_adjust(model)
    write(model, out)


def test_an_offset_principal_point_and_the_poses_are_recovered(biased, tmp_path):
    true = truth(OFF, 0.0)
    report, model = refined(biased, tmp_path)
    found = report.counters
    assert found.freed and found.error_px < found.error_before_px
    np.testing.assert_allclose(model.cameras[1].pinhole[2:], true.cameras[1].pinhole[2:], atol=0.7)
    before, now = pose_error(biased, true), pose_error(model, true)
    assert now.rotation_median_deg < 0.2 * before.rotation_median_deg


def test_the_refined_model_stays_in_the_input_frame(biased, tmp_path):
    """Tested at another scale and origin: other data of the user refers to the input frame."""
    far = replace(
        biased,
        images={
            number: replace(
                image, translation=40 * image.translation - image.rotation @ [300, 0, 50]
            )
            for number, image in biased.images.items()
        },
        points=replace(biased.points, xyz=40 * biased.points.xyz + [300, 0, 50]),
    )
    report, model = refined(far, tmp_path)
    assert report.counters.freed
    assert len(model.points) == POINTS
    moved = np.linalg.norm(model.points.xyz - far.points.xyz, axis=1)
    assert np.median(moved) < 0.1  # of 32


@pytest.mark.parametrize("noise_px, why", [(0.3, "fixed"), (0.0, "exactly")])
def test_a_model_without_gain_is_copied(tmp_path, noise_px, why):
    report, _ = refined(truth(np.zeros(2), noise_px), tmp_path)
    assert not report.counters.freed and why in " ".join(report.decisions)
    assert digests(tmp_path / "out") == digests(tmp_path / "given")


def test_points_outside_the_longest_tracks_are_adjusted_too(biased, tmp_path):
    """With a smaller limit of tracks per image, the other points follow the adjusted cameras."""
    report, all_of_them = refined(biased, tmp_path)
    few = run_isolated(_refine_with_limit, 150, tmp_path / "given", tmp_path / "few")
    assert report.counters.freed and few.counters.freed
    model = read_model(tmp_path / "few")
    assert len(model.points) == POINTS
    assert few.counters.error_px == pytest.approx(report.counters.error_px, rel=0.02)
    apart = np.linalg.norm(model.points.xyz - all_of_them.points.xyz, axis=1)
    assert np.median(apart) < 0.005


def _refine_with_limit(tracks: int, sparse: Path, out: Path) -> Any:
    from pipeline.sfm import known_poses

    known_poses.TRACKS_PER_IMAGE = tracks
    return _refine(sparse, Sfm(), out)


def test_the_result_is_deterministic(biased, tmp_path):
    for name in "ab":
        assert refined(biased, tmp_path / name)[0].counters.freed
    assert digests(tmp_path / "a") == digests(tmp_path / "b")


def test_inner_iterations_are_used_only_if_their_block_order_is_unique(tmp_path):
    """Ceres orders blocks with equally many neighbours by their address, which varies."""
    shared = truth(OFF, 0.3)
    own = replace(
        shared,
        cameras={number: shared.cameras[1] for number in shared.images},
        images={n: replace(image, camera_id=n) for n, image in shared.images.items()},
    )
    few = truth(OFF, 0.3, points=COUNT)
    for name, model, unique in [("shared", shared, True), ("own", own, False), ("few", few, False)]:
        write_model(tmp_path / name, model)
        assert run_isolated(_is_unique, tmp_path / name) is unique, name


def _is_unique(sparse: Path) -> bool:
    import pycolmap

    from pipeline.sfm.refine import _block_order_is_unique

    return _block_order_is_unique(pycolmap.Reconstruction(sparse))


def test_each_camera_is_freed_by_its_own_observations(tmp_path):
    """A few photographs of a camera with an offset principal point among many of a central one."""
    central, off = truth(np.zeros(2), 0.3), truth(OFF, 0.3)
    own = [number for number in central.images if number % 3 == 0]
    assert central.points is not None and off.points is not None
    # ``truth`` lists the observations of each point in the order of the images.
    xy = central.points.track_xy.copy()
    from_off = np.isin(central.points.track_image_id, own)
    xy[from_off] = off.points.track_xy[from_off]
    images = {
        number: replace(image, camera_id=2 if number in own else 1)
        for number, image in central.images.items()
    }
    camera = central.cameras[1]
    given = replace(
        central,
        cameras={1: camera, 2: camera},
        images=images,
        points=replace(central.points, track_xy=xy),
    )
    report, model = refined(given, tmp_path)
    assert "of 1 of 2 cameras" in " ".join(report.decisions)
    np.testing.assert_allclose(model.cameras[2].pinhole[2:], off.cameras[1].pinhole[2:], atol=0.7)
    np.testing.assert_array_equal(model.cameras[1].pinhole[2:], camera.pinhole[2:])
