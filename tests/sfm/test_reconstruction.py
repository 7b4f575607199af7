"""From photographs to poses: accuracy, independence of the number of threads, quality check."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.config import settled
from pipeline.io.colmap import read_model, write_model
from pipeline.metrics.pose import pose_error
from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import run_isolated
from pipeline.sfm.features import extract_features
from pipeline.sfm.judge import judge
from pipeline.sfm.triangulation import TriangulationOptions, triangulate
from tests.counters import GOOD
from tests.sfm import corner, jobs

FEATURES = settled.Features(max_features=1500)
INCREMENTAL = settled.Sfm(mapper="incremental")


def features(folder: Path, photos, config=FEATURES) -> Path:
    found, cache = folder / "features", folder / "cache"
    extract_features(corner.manifest(photos), config, found, cache=cache, threads=2)
    return found


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Folder, photographs, true model, features of eight photographs of a room's corner."""
    folder = tmp_path_factory.mktemp("room")
    photos, truth = corner.write_scene(folder / "photos", 8, camera_group="a")
    return folder, photos, truth, features(folder, photos)


def test_poses_are_accurate_and_files_do_not_depend_on_threads(room, tmp_path):
    _, photos, truth, found = room
    manifest = corner.manifest(photos)
    for threads in (1, 2):
        matched, report = run_isolated(
            jobs.match_and_reconstruct,
            manifest,
            found,
            tmp_path / str(threads),
            INCREMENTAL,
            threads,
        )
    assert jobs.digests(tmp_path / "1") == jobs.digests(tmp_path / "2")
    assert matched["components"] == [8] and matched["num_pairs"] == 28
    assert report["registered"] == report["total"] == 8
    assert report["verdict"] == "good" and report["warnings"] == []
    assert report["mean_reprojection_error_px"] < 0.5
    model = read_model(tmp_path / "1" / "sfm" / "sparse" / "0")
    assert len(model.points) == report["num_points"] > 500
    error = pose_error(model, truth)
    assert error.rotation_median_deg < 0.1 and error.centre_relative_median < 0.003
    # Points have the colours of the textures.
    assert model.points.rgb.astype(float).std(axis=0).min() > 20


@pytest.mark.slow
def test_global_mapping_is_accurate_and_repeatable(room, tmp_path):
    _, photos, truth, found = room
    manifest, config = corner.manifest(photos), settled.Sfm(mapper="global")
    run_isolated(jobs.match, manifest, found, tmp_path / "matches")
    database = tmp_path / "matches" / "database.db"
    before = database.read_bytes()
    for run in "12":
        report = run_isolated(jobs.reconstruct, manifest, database, config, tmp_path / run)
    assert jobs.digests(tmp_path / "1") == jobs.digests(tmp_path / "2")
    assert database.read_bytes() == before, "a stage changed its input"
    assert report["mapper"] == "global" and report["registered"] == 8
    error = pose_error(read_model(tmp_path / "1" / "sparse" / "0"), truth)
    assert error.rotation_median_deg < 0.2 and error.centre_relative_median < 0.005


@pytest.mark.slow
def test_of_two_scenes_in_one_folder_the_larger_is_used_with_a_warning(room, tmp_path):
    _, photos, _, _ = room
    others, _ = corner.write_scene(tmp_path / "photos", 4, seed=2, prefix="other ")
    both = [*photos, *others]
    found = features(tmp_path, both)
    matched, report = run_isolated(
        jobs.match_and_reconstruct, corner.manifest(both), found, tmp_path, INCREMENTAL
    )
    assert matched["components"] == [8, 4]
    assert matched["isolated"] == [photo.name for photo in others]
    assert (
        "into 2 separate groups" in matched["warnings"][0] and "8 of 12" in matched["warnings"][0]
    )
    assert report["registered"] == 8
    assert [len(component["photographs"]) for component in report["components"]] == [8, 4]
    assert report["not_registered"] == [photo.name for photo in others]
    assert report["verdict"] == "weak"
    assert len(read_model(tmp_path / "sfm" / "other_models" / "1").images) == 4


def test_photographs_without_overlap_are_an_error(tmp_path):
    photos = []
    for seed in range(3):
        photos += corner.write_scene(tmp_path / "p", 1, seed=20 + seed, prefix=f"{seed} ")[0]
    with pytest.raises(UserError, match="no two of the 3 photographs overlap") as e:
        run_isolated(
            jobs.match, corner.manifest(photos), features(tmp_path, photos), tmp_path / "m"
        )
    assert e.value.fix is not None


def test_photographs_without_features_are_the_same_error(tmp_path):
    tmp_path.joinpath("p").mkdir()
    photos = []
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / "p" / name), np.full((100, 120, 3), 90, np.uint8))
        photos.append(corner.photo(tmp_path / "p" / name))
    for pairs in ("exhaustive", "retrieval"):
        with pytest.raises(UserError, match="no two of the 2 photographs"):
            run_isolated(
                jobs.match,
                corner.manifest(photos),
                features(tmp_path, photos),
                tmp_path / "m",
                pairs,
            )


@pytest.mark.slow
def test_pure_rotation_is_an_error(tmp_path):
    rotation, translation = corner.poses(3)[1]
    photos = []
    for index, angle in enumerate(np.radians([-8, -4, 0, 4, 8])):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        path = tmp_path / f"{index}.png"
        cv2.imwrite(str(path), corner.picture(turn @ rotation, turn @ translation, 1))
        photos.append(corner.photo(path))
    found = features(tmp_path, photos)
    with pytest.raises(UserError, match="the camera only turned"):
        run_isolated(
            jobs.match_and_reconstruct, corner.manifest(photos), found, tmp_path, INCREMENTAL
        )


def test_a_photograph_missing_from_the_database_is_named(room, tmp_path):
    _, photos, _, found = room
    run_isolated(jobs.match, corner.manifest(photos[:3]), found, tmp_path)
    with pytest.raises(UserError, match=r"1 photographs are not in the database.*view 04"):
        run_isolated(
            jobs.reconstruct,
            corner.manifest(photos[:4]),
            tmp_path / "database.db",
            INCREMENTAL,
            tmp_path / "out",
        )


def test_cameras_are_shared_as_configured_with_median_priors(room):
    _, photos, _, _ = room
    facts = [("a", 300.0), ("a", 380.0), ("a", 400.0), ("b", None)]
    manifest = corner.manifest(
        [
            photo.model_copy(update={"camera_group": group, "focal_px": focal})
            for photo, (group, focal) in zip(photos, facts, strict=False)
        ]
    )
    cameras = run_isolated(jobs.planned_cameras, manifest, ["group", "single", "image"])
    # The prior of a group is the median of its photographs' priors; the default without any.
    assert cameras["group"] == [("SIMPLE_RADIAL", 380.0, True), ("SIMPLE_RADIAL", 480.0, False)]
    assert cameras["single"] == [("SIMPLE_RADIAL", 380.0, True)]
    assert [focal for _, focal, _ in cameras["image"]] == [300.0, 380.0, 400.0, 480.0]


def triangulated(folder: Path, photos):
    """The report of the triangulation of the model in "given", into "out"."""
    options = TriangulationOptions(FEATURES, settled.Matches(), seed=0)
    return triangulate(
        corner.manifest(photos), folder / "given", folder / "out", options, threads=2
    )


def test_known_poses_are_triangulated_and_unchanged(room, tmp_path):
    _, photos, truth, _ = room
    # Cameras of half the size, as for images_2; one image has no photograph.
    half = replace(truth, cameras={1: corner.camera().resized(200, 150)})
    write_model(tmp_path / "given", half)
    report = triangulated(tmp_path, photos[:7])
    model = read_model(tmp_path / "out")
    assert report.num_points == len(model.points) > 500
    assert report.num_images == len(model.images) == 7
    for image in model.images.values():
        true = truth.by_name()[image.name]
        np.testing.assert_allclose(image.world_to_camera, true.world_to_camera, atol=1e-12)
    assert model.cameras[1].pinhole == pytest.approx(corner.camera().pinhole)
    # Every point lies on the floor or on a wall: the nearest plane is x = 0, y = 0 or z = 0.
    distance = np.abs(model.points.xyz).min(axis=1)
    assert np.median(distance) < 0.003 and np.percentile(distance, 90) < 0.03


def test_triangulation_without_matches_gives_no_points(tmp_path):
    photos, truth = [], None
    for seed in range(2):
        more, truth = corner.write_scene(tmp_path / "p", 2, seed=30 + seed, prefix=f"{seed} ")
        photos.append(more[seed])
    images = {
        i: replace(truth.images[i], name=photo.name) for i, photo in enumerate(photos, start=1)
    }
    write_model(tmp_path / "given", replace(truth, images=images))
    report = triangulated(tmp_path, photos)
    assert report.num_points == 0
    assert len(read_model(tmp_path / "out").images) == 2


def test_two_photographs_are_enough(room, tmp_path):
    _, photos, truth, found = room
    manifest = corner.manifest([photos[2], photos[4]])
    _, report = run_isolated(jobs.match_and_reconstruct, manifest, found, tmp_path, INCREMENTAL)
    assert report["registered"] == 2 and report["num_points"] > 100
    model = read_model(tmp_path / "sfm" / "sparse" / "0")
    names = set(model.by_name())
    pair = replace(truth, images={i: v for i, v in truth.images.items() if v.name in names})
    error = pose_error(model, pair)
    # Two views hardly determine the focal length: only the rotation is checked.
    assert error.rotation_median_deg < 5


def test_sharing_cameras_by_size_recovers_from_wrong_priors(tmp_path):
    photos, truth = corner.write_scene(tmp_path / "photos", 5)
    # With more features, mapping recovers from the priors by itself.
    found = features(tmp_path, photos, settled.Features(max_features=600))
    focals = [150.0, 1900.0, 120.0, 2500.0, 100.0]
    wrong = [
        photo.model_copy(update={"camera_group": photo.name, "focal_px": focal})
        for photo, focal in zip(photos, focals, strict=True)
    ]
    _, report = run_isolated(
        jobs.match_and_reconstruct, corner.manifest(wrong), found, tmp_path, INCREMENTAL
    )
    *others, taken = report["attempts"]
    assert [a["verdict"] for a in others] == ["weak", "failed"], report
    assert "one camera for all" in taken["change"] and taken["taken"]
    assert report["verdict"] == taken["verdict"] == "good" and report["registered"] == 5
    error = pose_error(read_model(tmp_path / "sfm" / "sparse" / "0"), truth)
    assert error.rotation_median_deg < 0.5


@pytest.mark.parametrize(
    ("change", "grade", "reason"),
    [
        ({}, "good", None),
        ({"focal_off": None}, "good", None),
        ({"registered": 14}, "weak", "14 of 20 photographs"),
        ({"registered": 9}, "failed", "9 of 20 photographs"),
        ({"explained_matches": 0.3}, "weak", "30% of the verified matches"),
        ({"explained_matches": 0.1}, "failed", "10% of the verified matches"),
        ({"observations_per_image": 8}, "failed", "only 8 points"),
        ({"observations_per_image": 40}, "weak", "only 40 points"),
        ({"focal_off": 2.5}, "good", None),
        ({"focal_off": 1.5, "focal_certainty": 0.02}, "weak", "by a factor of 1.5"),
        ({"focal_off": None, "focal_certainty": 1e-3}, "weak", "hardly determine the focal length"),
        ({"agreeing_pairs": 0.8}, "failed", "20% of the strongest pairs"),
        ({"agreeing_pairs": 0.95}, "weak", "5% of the strongest pairs"),
        ({"agreeing_distinctive": 0.9}, "failed", "no other photograph shows"),
        ({"agreeing_distinctive": 0.97}, "weak", "no other photograph shows"),
        ({"broken_steps": 1}, "failed", "turns abruptly at 1 step"),
        ({"missing_covisibility": 0.5}, "failed", "50% of neighbouring"),
        ({"missing_covisibility": 0.32}, "weak", "32% of neighbouring"),
        ({"agreeing_pairs": 0.96, "missing_covisibility": 0.2}, "failed", "look alike"),
        ({"focal_relative": 0.1}, "failed", "0.10 times the image"),
        ({"behind_camera": 0.2}, "failed", "20% of the points are behind"),
        ({"parallax": 0.003, "median_angle_deg": 2.1}, "weak", "only turned"),
        ({"parallax": 0.001}, "failed", "only turned"),
        ({"median_angle_deg": 0.5}, "weak", "hardly moved"),
    ],
)
def test_verdicts_follow_from_the_evidence(change, grade, reason):
    verdict = judge(GOOD.model_copy(update=change), min_registered_share=0.5)
    assert verdict.grade == grade
    assert reason is None or reason in "; ".join(verdict.reasons)


def test_no_model_is_a_failure():
    assert judge(None, 0.5).grade == "failed"


def test_a_verdict_has_remedies_and_whether_another_attempt_may_help():
    rotating = judge(GOOD.model_copy(update={"parallax": 0.001}), 0.5)
    assert "move sideways" in rotating.remedies[0] and not rotating.worth_retrying
    repeated = judge(GOOD.model_copy(update={"agreeing_pairs": 0.5}), 0.5)
    assert "look alike" in repeated.remedies[0] and repeated.worth_retrying
    # The largest connected component is registered: no mapper can add the other images.
    complete = judge(GOOD.model_copy(update={"registered": 12, "reachable": 12}), 0.5)
    assert complete.grade == "weak" and not complete.worth_retrying
    assert judge(GOOD.model_copy(update={"registered": 12}), 0.5).worth_retrying
    slight = {"registered": 12, "parallax": 0.003, "median_angle_deg": 2.1}
    both = judge(GOOD.model_copy(update=slight), 0.5)
    assert both.grade == "weak" and not both.worth_retrying
