"""Which point cloud a scene has, and where its points are in the scene's world."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.config.schema import Config
from pipeline.io.colmap import read_model, write_model
from pipeline.plan.given_poses import load_given
from pipeline.plan.point_cloud import read_point_cloud
from pipeline.plan.scan import Scan, scan
from pipeline.runtime.errors import UserError
from pipeline.scene.normalization import Normalization
from tests.io.clouds.written import write_las, write_ply, write_text
from tests.pictures import photos
from tests.plan.test_scan import write_sparse
from tests.plans import make_plan

XYZ = np.random.default_rng(0).uniform(-1, 1, (40, 3))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    files = photos(tmp_path / "images", 3)
    write_sparse(tmp_path / "sparse" / "0", [path.name for path in files], (64, 48))
    return tmp_path


def look(folder: Path, **sections) -> Scan:
    return scan(folder, "scene", Config.model_validate(sections), cache=None)


def with_transforms(scene: Path, **fields) -> None:
    """Poses in transforms.json instead."""
    frames = [
        {"file_path": f"images/{path.name}", "transform_matrix": np.eye(4).tolist()}
        for path in sorted((scene / "images").iterdir())
    ]
    for path in (scene / "sparse" / "0").iterdir():
        path.unlink()
    content = {"w": 64, "h": 48, "fl_x": 60.0, "frames": frames, **fields}
    (scene / "transforms.json").write_text(json.dumps(content))


def placed(found: Scan) -> np.ndarray:
    assert found.poses is not None and found.cloud is not None
    path = found.folder / found.poses.path
    given = load_given(path, found.poses.kind, found.photos, found.listed, found.base_folder)
    return read_point_cloud(found.folder, found.cloud, found.poses, given).xyz


def test_a_cloud_is_found_counted_and_planned(scene):
    assert look(scene).cloud is None
    before = look(scene).fingerprint
    write_las(scene / "points.laz", XYZ, None)
    found = look(scene)
    assert found.cloud is not None and found.cloud.text == "40 points of points.laz"
    assert found.fingerprint != before
    np.testing.assert_allclose(placed(found), XYZ, atol=1e-4)
    plan = make_plan(found, Config())
    assert plan.facts.point_cloud == found.cloud
    assert plan.stages["init"].reason.startswith("Gaussians from 40 points of points.laz, subs")
    assert any("sparse points are still used" in line for line in plan.stages["init"].decisions)
    assert plan.config.init.points_file == "points.laz"
    assert look(scene, init={"points_file": "none"}).cloud is None
    random = make_plan(found, Config.model_validate({"init": {"method": "random"}}))
    assert random.stages["init"].reason.endswith("random Gaussians")


def test_a_folder_of_files_is_one_cloud(scene):
    (scene / "points").mkdir()
    assert look(scene).cloud is None
    write_ply(scene / "points" / "a.ply", XYZ[:10], None)
    write_text(scene / "points" / "b.xyz", XYZ[10:], None)
    found = look(scene)
    assert found.cloud is not None and found.cloud.files == ("points/a.ply", "points/b.xyz")
    assert found.cloud.points is None and "points (2 files)" in found.cloud.text
    np.testing.assert_allclose(placed(found), XYZ, atol=1e-5)


def test_two_clouds_are_a_question_to_the_user(scene):
    write_ply(scene / "points.ply", XYZ, None)
    write_text(scene / "points.xyz", XYZ, None)
    with pytest.raises(UserError, match="found 2: points"):
        look(scene)
    found = look(scene, init={"points_file": "points.xyz"})
    assert found.cloud is not None and found.cloud.path == "points.xyz"


@pytest.mark.parametrize("name", ["gone.ply", "../x.ply", "/etc/passwd", "images", "notes.txt"])
def test_a_configured_cloud_that_is_none_is_a_user_error(scene, name):
    (scene / "notes.txt").write_text("1 2 3")
    with pytest.raises(UserError, match="points_file"):
        look(scene, init={"points_file": name})


def test_points_move_with_the_poses(scene):
    """UTM in millimetres: the difference is taken in float64, and rounded as the poses are."""
    there = Normalization(1e-3, np.array([5e8, 5e9, 3e5]))
    sparse = scene / "sparse" / "0"
    near = read_model(sparse)
    write_model(sparse, there.model_to_given(near))
    write_ply(scene / "points.ply", there.to_given(XYZ), None)
    found = look(scene)
    given = load_given(sparse, "colmap", found.photos)
    offset = given.model.images[1].centre - near.images[1].centre
    np.testing.assert_allclose(placed(found) - offset, XYZ, atol=1e-5)


def test_the_cloud_of_transforms_is_in_the_coordinates_of_its_matrices(scene):
    applied = np.array([[0, 2.0, 0, 1], [2, 0, 0, -3], [0, 0, -2, 0.5]])
    with_transforms(scene, ply_file_path="./sparse_pc.ply", applied_transform=applied.tolist())
    stored = XYZ @ applied[:, :3].T + applied[:, 3]
    write_ply(scene / "sparse_pc.ply", stored, None)
    found = look(scene)
    assert found.cloud is not None and found.cloud.path == "sparse_pc.ply"
    np.testing.assert_allclose(placed(found), XYZ, atol=1e-12)


@pytest.mark.parametrize("name", ["gone.ply", "../up.ply", "/etc/passwd", "images", 7, ["a"], ""])
def test_a_named_cloud_that_is_none_is_a_warning(scene, name):
    with_transforms(scene, ply_file_path=name)
    write_ply(scene.parent / "up.ply", XYZ, None)
    found = look(scene)
    assert found.cloud is None
    assert bool(found.warnings) == (isinstance(name, str) and name != "")


def test_a_cloud_needs_given_poses_or_ground_control(scene):
    write_ply(scene / "points.ply", XYZ, None)
    found = look(scene, poses="ignore")
    assert found.cloud is None
    assert any("cannot be placed" in line for line in found.warnings)
    with pytest.raises(UserError, match="cannot be placed"):
        look(scene, poses="ignore", init={"points_file": "points.ply"})
    (scene / "gcp_list.txt").write_text("WGS84 UTM 32N\n")
    assert look(scene, poses="ignore").cloud is not None
    assert look(scene, poses="ignore", sfm={"georeference": "gps"}).cloud is None


def test_a_damaged_header_is_one_error(scene):
    (scene / "points.las").write_bytes(b"LASF" + bytes(400))
    (scene / "points.las").write_bytes(b"PK" + bytes(400))
    with pytest.raises(UserError, match="LAS or LAZ"):
        look(scene)
