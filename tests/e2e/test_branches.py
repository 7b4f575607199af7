"""Every branch of the plan through Snakemake: what a scene does not need is no job."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest

from pipeline.io.colmap import read_model, write_model
from pipeline.scene.normalization import Normalization
from tests.e2e.harness import TINY, make_project, make_scene, metrics, rules_run, snakemake
from tests.once import made_once
from tests.videos import write_video

pytestmark = pytest.mark.slow

ALWAYS = {"plan", "inspect", "init", "train", "evaluate", "coverage", "export", "report"}
# Up to 30 photographs without alpha or masks.
FEW = ALWAYS | {"dense"}
PINHOLE = ("--distortion", "none")
SFM = {"features", "matches", "sfm"}
METRICS = "results/{}/metrics.json"
SHORT = TINY | {"train": TINY["train"] | {"steps": 120}}
MASKED = ("--poses", "colmap", "--masks", *PINHOLE)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    return make_project(tmp_path_factory.mktemp("branches") / "project")


@pytest.fixture(scope="session")
def masked(tmp_path_factory):
    """The folder of a scene with exact poses and masks."""

    def make(project):
        make_scene(project, "masked", *MASKED)

    return made_once(tmp_path_factory, "e2e-masked", make) / "data/masked"


# For scenes with poses: too small for structure from motion.
SMALL = ("--views", "15", "--size", "100x76")
SCENES = {
    "raw": (("--format", "dng", "--views", "3"), FEW | SFM | {"decode", "undistort"}),
    "bare": (("--poses", "transforms", "--no-points", *PINHOLE, *SMALL), FEW),
    "raw_lens": (
        ("--format", "dng", "--poses", "colmap", "--distortion", "opencv", *SMALL),
        FEW | {"decode", "refine", "undistort"},
    ),
    "alpha": (("--poses", "transforms", "--format", "png", "--alpha", *PINHOLE, *SMALL), ALWAYS),
}


def test_the_plan_runs_what_each_scene_needs(project):
    for scene, (options, _) in SCENES.items():
        make_scene(project, scene, *options)
    planned = snakemake(project, "-n", *map(METRICS.format, SCENES), config=SHORT)
    for scene, (_, expected) in SCENES.items():
        assert rules_run(planned, scene) == expected
    ran = ("raw_lens", "alpha")
    done = snakemake(project, *map(METRICS.format, ran), config=SHORT)
    for scene in ran:
        expected = SCENES[scene][1]
        assert rules_run(done, scene) == expected
        check_metrics(project, scene, expected)


def check_metrics(project, scene, expected) -> None:
    found = metrics(project, scene)
    assert {name for name, s in found["stages"].items() if not s["skipped"]} == expected - {"plan"}
    assert all(s["reason"] for s in found["stages"].values() if s["skipped"])
    assert found["registered_images"] == found["total_images"]
    assert found["psnr"] > 18
    assert found["pose_error"]["rotation_median_deg"] < 0.3


def test_a_cloud_and_poses_in_millimetres_far_away_become_a_scene(project, masked):
    """Gaussians start from the cloud, and exported cameras are where the given ones are."""
    folder = project / "data" / "far"
    shutil.copytree(masked, folder)
    there = Normalization(1e-3, np.array([1e9, -1e9, 1e9]))
    given = there.model_to_given(read_model(folder / "sparse" / "0"))
    write_model(folder / "sparse" / "0", given)
    rows = np.column_stack([given.points.xyz, given.points.rgb])
    np.savetxt(folder / "points.xyz", rows, fmt="%.4f %.4f %.4f %d %d %d")
    done = snakemake(project, "results/far/metrics.json", config=SHORT | {"poses": "keep"})
    assert " 0 MB" not in done.stderr
    results = project / "results" / "far"
    reason = json.loads((results / "plan.json").read_text())["stages"]["init"]["reason"]
    assert reason.startswith("Gaussians from") and "points.xyz" in reason
    assert metrics(project, "far")["psnr"] > 18
    found = read_model(results / "export" / "sparse" / "0").by_name()
    for image in given.images.values():
        np.testing.assert_allclose(found[image.name].centre, image.centre, rtol=1e-9)


def test_frames_of_a_video_become_a_scene(project, masked):
    """A photograph is one frame of the video; the camera moves far between them."""
    views = [cv2.imread(str(path)) for path in sorted((masked / "images").iterdir())]
    write_video(project / "data" / "video" / "walk.mp4", views)
    planned = snakemake(project, "-n", "results/video/metrics.json", config=SHORT)
    assert rules_run(planned) == FEW | SFM | {"decode", "undistort"}
    snakemake(
        project, "results/video/undistort/stage.json", "results/video/plan.json", config=SHORT
    )
    results = project / "results" / "video"
    sfm = json.loads((results / "sfm" / "stage.json").read_text())["counters"]
    assert sfm["total"] == len(views)
    assert sfm["registered"] >= 0.9 * len(views)
    plan = json.loads((results / "plan.json").read_text())
    assert plan["stages"]["decode"]["reason"] == f"1 video: at most {len(views)} frames"


def test_panoramas_and_photographs_become_one_scene(project):
    folder = project / "data" / "mixed" / "images"
    folder.mkdir(parents=True)
    panoramas = ("--views", "8", "--size", "400x200", "--distortion", "equirectangular")
    for part, options in (("whole", panoramas), ("part", ("--views", "16"))):
        make_scene(project, part, *options)
        for photo in (project / "data" / part / "images").iterdir():
            photo.rename(folder / f"{part}_{photo.name}")
    done = snakemake(project, "results/mixed/metrics.json", config=SHORT)
    assert rules_run(done) == ALWAYS | SFM | {"undistort"}
    found = metrics(project, "mixed")
    assert found["input"].startswith("24 photographs (8 panoramas)")
    assert found["registered_images"] == 24 and found["psnr"] > 18
    views = {view["name"].split("_")[0] for view in found["per_view"]}
    assert views == {"whole", "part"}
    sfm = json.loads((project / "results/mixed/sfm/stage.json").read_text())
    assert sfm["counters"]["verdict"] == "good"


def test_cameras_that_training_moves_are_what_comes_out(project, masked):
    """The scene's poses are exact, so that what moves them must do no harm."""
    shutil.copytree(masked, project / "data/moving")
    ignored = snakemake(project, "-n", METRICS.format("moving"), config={"poses": "ignore"})
    assert rules_run(ignored) >= SFM
    moves = {"refine_poses": True, "refine_intrinsics": True}
    limits = {"max_pose_change": 0.003, "max_intrinsics_change": 0.003}
    config = {**SHORT, "train": {**SHORT["train"], **moves}, "experiments": {"train": limits}}
    done = snakemake(project, METRICS.format("moving"), config=config)
    assert rules_run(done) == ALWAYS | {"refine"}
    check_metrics(project, "moving", ALWAYS | {"refine"})
    results, found = project / "results" / "moving", metrics(project, "moving")
    assert "pose of each test camera is optimised" in found["protocol"]["poses"]
    assert found["pose_error"]["rotation_median_deg"] > 0
    told = read_model(project / "data" / "moving" / "sparse" / "0")
    model = read_model(results / "export" / "sparse" / "0")
    given, exported = told.by_name(), model.by_name()
    assert exported.keys() == given.keys()
    for name, image in exported.items():
        before, now = told.cameras[given[name].camera_id], model.cameras[image.camera_id]
        factor = now.pinhole[0] / now.width / (before.pinhole[0] / before.width)
        assert 1e-6 < abs(factor - 1) < 0.01
    for name, image in exported.items():
        assert 1e-5 < abs(image.rotation - given[name].rotation).max() < 0.02
