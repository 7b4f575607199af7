"""Depth maps and fused cloud of a scene: true, the same at any number of threads, for any input."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.mvs.dense import DenseOptions, reconstruct
from pipeline.mvs.initial import surface_points
from pipeline.mvs.maps import DenseMap, planes_of, read_dense_cloud, read_map, write_map
from pipeline.mvs.sources import select_sources
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Points
from pipeline.scene.views import View
from tests.mvs import planar
from tests.mvs.planar_scene import model_of, scene


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("planar")
    views, model = scene(folder / "images")
    report = reconstruct(views, model, folder / "out", folder / "scratch", 2)
    return views, model, folder, report


def test_depths_are_those_of_the_plane(result):
    views, _, folder, report = result
    assert report.counters.depth_maps == 4 and not report.warnings
    for view in views:
        found = read_map(folder / "out", view.name)
        known = found.depth > 0
        assert known[10:-10, 10:-10].mean() > 0.7
        error = np.abs(found.depth / planar.depth(view) - 1)[known]
        assert np.median(error) < 0.002 and (error < 0.01).mean() > 0.97
        assert ((found.confidence > 0) == known).all() and (found.confidence <= 1).all()
        expected = -view.world_to_camera[:3, :3] @ planar.NORMAL / np.linalg.norm(planar.NORMAL)
        assert np.degrees(np.arccos(np.median(found.normals[known] @ expected))) < 3


def test_the_cloud_is_on_the_plane_and_has_each_point_once(result):
    views, _, folder, report = result
    cloud = read_dense_cloud(folder / "out")
    assert len(cloud) == report.counters.dense_points
    distance = np.abs(cloud.xyz @ planar.NORMAL - 1) / np.linalg.norm(planar.NORMAL)
    assert np.median(distance) < 0.01
    known = sum((read_map(folder / "out", view.name).depth > 0).sum() for view in views)
    # Most pixels are seen by three views or more.
    assert 0.2 * known < len(cloud) < 0.6 * known
    expected = -planar.NORMAL / np.linalg.norm(planar.NORMAL)
    assert np.median(cloud.normals @ expected) > 0.99
    shades = planar.pictures()[0].grey
    assert shades.min() <= cloud.rgb.min() and cloud.rgb.max() <= 255


def digest(folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def test_results_are_the_same_with_one_thread_and_after_an_interruption(result, tmp_path):
    views, model, folder, _ = result
    (tmp_path / "scratch" / "planes").mkdir(parents=True)
    stored = (folder / "scratch" / "planes" / "2.npy").read_bytes()
    (tmp_path / "scratch" / "planes" / "2.npy").write_bytes(stored)
    reconstruct(views, model, tmp_path / "out", tmp_path / "scratch", 1)
    assert digest(tmp_path / "out") == digest(folder / "out")


def test_masked_pixels_have_no_depth(result, tmp_path):
    views, model, *_ = result
    mask = np.full((72, 96), 255, np.uint8)
    mask[20:50, 30:60] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    masked = [replace(views[0], mask=str(tmp_path / "mask.png")), *views[1:]]
    reconstruct(masked, model, tmp_path / "out", tmp_path, 1)
    depth = read_map(tmp_path / "out", views[0].name).depth
    assert not depth[mask == 0].any() and depth[mask > 0].any()


def test_without_points_depths_are_still_found(result, tmp_path):
    views, model, *_ = result
    model = replace(model, points=Points.empty())
    reconstruct(views, model, tmp_path / "out", tmp_path, 1)
    depth = read_map(tmp_path / "out", views[0].name).depth
    known = depth > 0
    assert known.mean() > 0.4
    assert np.median(np.abs(depth / planar.depth(views[0]) - 1)[known]) < 0.005


def test_a_view_alone_has_an_empty_map(result, tmp_path):
    views, *_ = result
    model = model_of(views[:1], np.zeros((0, 3)))
    report = reconstruct(views[:1], model, tmp_path / "out", tmp_path, 1)
    assert report.counters.without_sources == 1 and report.counters.dense_points == 0
    assert any("1 of 1 training views" in text for text in report.warnings)
    assert not read_map(tmp_path / "out", views[0].name).depth.any()
    assert len(read_dense_cloud(tmp_path / "out")) == 0


def test_the_cloud_has_at_most_so_many_points(result, tmp_path):
    views, model, folder, _ = result
    options = DenseOptions(max_points=1000)
    reconstruct(views, model, tmp_path / "out", folder / "scratch", 1, options)
    assert 500 < len(read_dense_cloud(tmp_path / "out")) <= 1000


def test_initial_points_are_thinned_with_their_normals_and_holes_are_filled(result):
    views, model, folder, _ = result
    cloud = read_dense_cloud(folder / "out")
    far = np.array([[0.0, 0.0, 9.0], [np.nan, 0, 0]])
    sparse = model_of(views, np.concatenate([model.points.xyz, far])).points
    found = surface_points(cloud, sparse, views, 300)
    count = len(found.points) - found.num_sparse
    assert 200 < count <= 300 and found.num_sparse < 15
    np.testing.assert_allclose(np.linalg.norm(found.normals[:count], axis=1), 1, atol=1e-5)
    assert np.isnan(found.normals[count:]).all()
    assert (found.points.xyz[-1] == far[0]).all()


def test_a_missing_photograph_is_a_user_error(result, tmp_path):
    views, model, *_ = result
    gone = [replace(views[0], image=str(tmp_path / "gone.png")), *views[1:]]
    with pytest.raises(UserError, match="gone"):
        reconstruct(gone, model, tmp_path / "out", tmp_path, 2)


def test_maps_are_stored_with_small_errors(tmp_path):
    rng = np.random.default_rng(0)
    depth = np.exp(rng.uniform(-3, 4, (31, 17))).astype(np.float32)
    depth[:5] = 0
    normals = rng.normal(size=(31, 17, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[:5] = 0
    confidence = np.where(depth > 0, rng.random((31, 17)), 0).astype(np.float32)
    write_map(tmp_path, "a/b.jpg", DenseMap(depth, normals.astype(np.float32), confidence))
    found = read_map(tmp_path, "a/b.jpg")
    np.testing.assert_allclose(found.depth, depth, rtol=1e-4)
    np.testing.assert_allclose(found.normals, normals, atol=0.03)
    np.testing.assert_allclose(found.confidence, confidence, atol=0.004)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 damaged"])
def test_a_damaged_map_is_a_user_error(tmp_path, content):
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "x.png.npz").write_bytes(content)
    with pytest.raises(UserError, match="damaged"):
        read_map(tmp_path, "x.png")
    with pytest.raises(UserError, match="found none"):
        read_map(tmp_path, "y.png")


def test_planes_of_depths_and_normals_are_those_of_the_surface():
    camera = planar.view(planar.CENTRES[0], 40, 30)
    unit = -planar.NORMAL / np.linalg.norm(planar.NORMAL)
    normals = np.broadcast_to(unit, (30, 40, 3)).astype(np.float32)
    depth = planar.depth(camera).astype(np.float32)
    np.testing.assert_allclose(
        planes_of(depth, normals, camera), planar.true_planes(camera), rtol=1e-4
    )


def row_of_views(positions: list[float]) -> list[View]:
    return [planar.view((x, 0.0, 0.0), 64, 48, f"{x}") for x in positions]


def test_sources_have_a_good_angle_and_cover_the_view():
    views = row_of_views([0.0, 0.001, 0.9, -0.9, 30.0])
    xyz = np.random.default_rng(0).uniform([-1, -1, 4.5], [1, 1, 5.5], (50, 3))
    model = model_of(views, xyz)
    assert sorted(select_sources(views, model, 2)[0].tolist()) == [2, 3]
    # Not the view at nearly the same position.
    assert 1 not in select_sources(views, model, 6)[0]


def test_sources_without_points_are_the_nearest_with_a_similar_direction():
    views = row_of_views([0.0, 2.0, 1.0, 0.0])
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ views[2].world_to_camera
    views.append(replace(views[2], name="turned", world_to_camera=turned))
    chosen = select_sources(views, model_of(views, np.zeros((0, 3))), 6)
    assert chosen[0].tolist() == [2, 1] and chosen[4].tolist() == []
