"""Given poses are adjusted to their tracks where their principal point was only assumed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.config.schema import Sfm
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import read_model, write_model
from pipeline.metrics.pose import pose_error
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.sfm.isolate import run_isolated
from tests.sfm import corner
from tests.sfm.jobs import digests

COUNT, POINTS = 16, 250
# Of the longer side, 1.5 and 1 per cent: a common phone.
OFF = np.array([-6.0, 4.0])


def roll(degrees: float) -> np.ndarray:
    """As hands hold a camera: what tells a shifted principal point from a turned camera."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def truth(off: np.ndarray, noise_px: float, points: int = POINTS) -> Reconstruction:
    """Cameras on an arc around points that they all see, ``noise_px`` beside where they are."""
    rng = np.random.default_rng(0)
    params = np.array([corner.FOCAL, corner.WIDTH / 2 + off[0], corner.HEIGHT / 2 + off[1], 0.0])
    images = {}
    for i, (rotation, translation) in enumerate(corner.poses(COUNT), start=1):
        turn = roll(30 * (-1) ** i)
        images[i] = PosedImage(f"{i:02d}.png", 1, turn @ rotation, turn @ translation)
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


def centred(model: Reconstruction) -> Reconstruction:
    camera = model.cameras[1]
    params = camera.params.copy()
    params[1:3] = camera.width / 2, camera.height / 2
    return replace(model, cameras={1: replace(camera, params=params)})


def adjusted(given: Reconstruction, folder: Path, **options: Any) -> tuple[Any, Reconstruction]:
    write_model(folder / "given", given)
    report = run_isolated(_refine, folder / "given", Sfm.model_validate(options), folder / "out")
    return report, read_model(folder / "out")


def _refine(sparse: Path, config: Sfm, out: Path) -> Any:
    from pipeline.sfm.refine_given import refine_given

    return refine_given(sparse, config, out)


@pytest.fixture(scope="module")
def bent(tmp_path_factory) -> Reconstruction:
    """What a program gives that holds the principal point in the middle: all else makes up."""
    folder = tmp_path_factory.mktemp("bent")
    write_model(folder / "free", centred(truth(OFF, 0.3)))
    run_isolated(_hold, folder / "free", folder / "held")
    return read_model(folder / "held")


def _hold(sparse: Path, out: Path) -> None:
    import pycolmap

    from pipeline.sfm.models import write_model as write
    from pipeline.sfm.quiet import quiet_colmap
    from pipeline.sfm.refine import adjust

    quiet_colmap()
    model = pycolmap.Reconstruction(sparse)
    adjust(model)
    write(model, out)


def test_a_principal_point_that_was_held_is_found_and_the_poses_with_it(bent, tmp_path):
    true = truth(OFF, 0.0)
    report, model = adjusted(bent, tmp_path)
    assert report.freed and report.error_px < report.error_before_px
    np.testing.assert_allclose(model.cameras[1].pinhole[2:], true.cameras[1].pinhole[2:], atol=0.7)
    before, now = pose_error(bent, true), pose_error(model, true)
    assert now.rotation_median_deg < 0.2 * before.rotation_median_deg


def test_the_adjusted_model_stays_in_the_given_world(bent, tmp_path):
    """Another scale and another place: nothing else that users have in this world may move."""
    far = replace(
        bent,
        images={
            number: replace(
                image, translation=40 * image.translation - image.rotation @ [300, 0, 50]
            )
            for number, image in bent.images.items()
        },
        points=replace(bent.points, xyz=40 * bent.points.xyz + [300, 0, 50]),
    )
    report, model = adjusted(far, tmp_path)
    assert report.freed
    assert len(model.points) == POINTS
    moved = np.linalg.norm(model.points.xyz - far.points.xyz, axis=1)
    assert np.median(moved) < 0.1  # of 32


@pytest.mark.parametrize("noise_px, why", [(0.3, "held"), (0.0, "exactly")])
def test_what_gains_nothing_stays_as_it_was_given(tmp_path, noise_px, why):
    report, _ = adjusted(truth(np.zeros(2), noise_px), tmp_path)
    assert not report.freed and why in " ".join(report.decisions)
    assert digests(tmp_path / "out") == digests(tmp_path / "given")


def test_points_beyond_what_poses_need_are_adjusted_too(bent, tmp_path):
    """With fewer tracks a photograph than there are, the others are moved between the cameras."""
    report, all_of_them = adjusted(bent, tmp_path)
    few = run_isolated(_refine_with, 150, tmp_path / "given", tmp_path / "few")
    assert report.freed and few.freed
    model = read_model(tmp_path / "few")
    assert len(model.points) == POINTS
    assert few.error_px == pytest.approx(report.error_px, rel=0.02)
    apart = np.linalg.norm(model.points.xyz - all_of_them.points.xyz, axis=1)
    assert np.median(apart) < 0.005


def _refine_with(tracks: int, sparse: Path, out: Path) -> Any:
    from pipeline.sfm import refine_given as given

    given.TRACKS_PER_IMAGE = tracks
    return given.refine_given(sparse, Sfm(), out)


def test_the_same_bytes_each_time(bent, tmp_path):
    for name in "ab":
        assert adjusted(bent, tmp_path / name)[0].freed
    assert digests(tmp_path / "a") == digests(tmp_path / "b")


def test_inner_iterations_are_left_out_where_their_order_is_open(tmp_path):
    """Two equally connected blocks of different kinds would come in the order of their addresses:
    other bits each time."""
    shared = truth(OFF, 0.3)
    own = replace(
        shared,
        cameras={number: shared.cameras[1] for number in shared.images},
        images={n: replace(image, camera_id=n) for n, image in shared.images.items()},
    )
    few = truth(OFF, 0.3, points=COUNT)
    for name, model, clear in [("shared", shared, True), ("own", own, False), ("few", few, False)]:
        write_model(tmp_path / name, model)
        assert run_isolated(_is_clear, tmp_path / name) is clear, name


def _is_clear(sparse: Path) -> bool:
    import pycolmap

    from pipeline.sfm.refine import _has_one_block_order

    return _has_one_block_order(pycolmap.Reconstruction(sparse))
