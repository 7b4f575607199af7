"""Depth maps of any unit and kind are fitted to the scene, or not used."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.runtime.errors import UserError
from pipeline.scene.views import View
from pipeline.training.data.depth_maps import add_maps, fit_map, map_depths
from pipeline.training.data.known_depths import KnownDepths, gaussian_depths
from tests.training.conftest import camera_at

VIEW = replace(camera_at(0.0), width=80, height=60, name="a.png")
AHEAD = View("a.png", "", None, 80, 60, 60.0, 60.0, 40.0, 30.0, np.eye(4), False)
KINDS = {
    "factor": lambda z: 1000.0 * z,
    "depth": lambda z: 40.0 * z + 300.0,
    "inverse": lambda z: 500.0 / z + 20.0,
}


def scene_depth() -> np.ndarray:
    """(60, 80): a floor with decreasing depth and a box in front of it."""
    z = np.repeat(np.linspace(6.0, 2.0, 60)[:, None], 80, 1)
    z[20:40, 30:50] = 1.5
    return z


def sparse(z: np.ndarray, wrong: int = 0) -> KnownDepths:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, (80, 60), (60, 2))
    known = z[xy[:, 1].astype(int), xy[:, 0].astype(int)].copy()
    known[:wrong] *= rng.uniform(1.5, 4.0, wrong)
    return KnownDepths(xy, known.astype(np.float32), np.ones(60, np.float32))


@pytest.mark.parametrize("kind", KINDS)
def test_maps_of_each_kind_are_fitted_despite_outliers(tmp_path, kind):
    z = scene_depth()
    np.save(tmp_path / "map.npy", KINDS[kind](z))
    samples, fit = map_depths(VIEW, str(tmp_path / "map.npy"), sparse(z, wrong=12))
    assert fit is not None and samples is not None
    assert fit.kind == kind
    truth = z[samples.xy[:, 1].astype(int), samples.xy[:, 0].astype(int)]
    np.testing.assert_allclose(samples.z, truth, rtol=0.01)
    assert len(samples) > 2000
    # None at the box's edges, where a pixel more or less is another depth.
    x, y = samples.xy.astype(int).T
    beside = ((x == 29) | (x == 30)) & (y >= 20) & (y < 40)
    assert not beside.any()


def test_millimetres_in_a_png_of_half_the_size_with_holes(tmp_path):
    z = scene_depth()
    values = np.rint(1000 * z[::2, ::2]).astype(np.uint16)
    values[:5] = 0  # a sensor's "no reading"
    cv2.imwrite(str(tmp_path / "map.png"), values)
    samples, fit = map_depths(VIEW, str(tmp_path / "map.png"), sparse(z))
    assert fit is not None and samples is not None and fit.kind == "factor"
    assert fit.a == pytest.approx(0.001, rel=0.05)
    assert samples.xy[:, 1].min() > 10


def test_maps_that_do_not_fit_or_have_no_points_are_not_used(tmp_path):
    z = scene_depth()
    np.save(tmp_path / "noise.npy", np.random.default_rng(1).uniform(1, 9, z.shape))
    few = KnownDepths(np.zeros((3, 2)), np.ones(3, np.float32), np.ones(3, np.float32))
    np.save(tmp_path / "map.npy", z)
    views = [VIEW, replace(VIEW, name="b.png"), replace(VIEW, name="c.png")]
    maps = [(str(tmp_path / "noise.npy"), None), (str(tmp_path / "map.npy"), None), None]
    points = [sparse(z), few, few]
    known, kinds, refused = add_maps(views, points, maps, points)
    assert refused == ["a.png", "b.png"] and kinds == {}
    assert [len(k) for k in known] == [60, 3, 3]


def test_values_that_are_not_finite_are_ignored():
    z = np.linspace(1.0, 5.0, 40)
    values = 2 * z
    values[::4] = np.nan
    fit = fit_map(values, z)
    assert fit is not None and fit.a == pytest.approx(0.5)
    assert fit_map(np.full(40, np.nan), z) is None
    assert fit_map(np.ones(40), z) is None


@pytest.mark.parametrize("shape", [(60, 80, 3), (80, 60)])
def test_a_map_of_another_aspect_ratio_is_an_error_that_names_the_file(tmp_path, shape):
    np.save(tmp_path / "map.npy", np.ones(shape))
    with pytest.raises(UserError) as error:
        map_depths(VIEW, str(tmp_path / "map.npy"), sparse(scene_depth()))
    assert "map.npy" in str(error.value)


@pytest.mark.parametrize("name", ["map.npy", "map.npz", "map.png", "map.tif"])
def test_a_file_that_is_not_a_depth_map_is_an_error_that_names_it(tmp_path, name):
    (tmp_path / name).write_bytes(b"nothing")
    with pytest.raises(UserError) as error:
        map_depths(VIEW, str(tmp_path / name), sparse(scene_depth()))
    assert name in str(error.value)


def test_maps_are_fitted_to_gaussians_where_no_point_has_a_track(tmp_path):
    """Poses of depth cameras come without sparse points. A wall hides the Gaussians behind it."""
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-3, 3, (4000, 2)), np.full(4000, 4.0)])
    (found,) = gaussian_depths([AHEAD], np.concatenate([wall, wall * 2, -wall]))
    assert len(found) > 1000
    assert (found.z == 4).mean() > 0.95
    np.save(tmp_path / "map.npy", np.full((60, 80), 4000.0))
    none = KnownDepths(np.zeros((0, 2)), np.zeros(0, np.float32), np.zeros(0, np.float32))
    known, kinds, _ = add_maps([AHEAD], [none], [(str(tmp_path / "map.npy"), None)], [found])
    assert kinds == {"factor": 1}
    np.testing.assert_allclose(known[0].z, 4, rtol=1e-3)
