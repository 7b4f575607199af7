"""Memory that jobs reserve: at least what stages took on real scenes, and not much more."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from pipeline.config.load import scene_config
from pipeline.config.schema import Config
from pipeline.io.posefiles import PoseSummary
from pipeline.plan.stage_memory import memory_mb, threads_within
from pipeline.plan.values import Plan
from stages.workflow.registry import STAGES
from tests.plans import FACTS, settled_config


class Scene(NamedTuple):
    """Photographs, their size, the size of views, and Gaussians."""

    photographs: int
    size: tuple[int, int]
    view: tuple[int, int]
    gaussians: int
    given_model: bool = False


SOUTH_BUILDING = Scene(128, (1024, 768), (640, 480), 76_800)
TOWN = Scene(125, (640, 427), (640, 427), 68_320, given_model=True)
COLOSSEUM = Scene(35, (640, 360), (640, 360), 57_600)
FOX = Scene(50, (720, 1280), (360, 640), 57_600)
# A town whose Gaussians were divided into many.
DENSE = Scene(60, (640, 427), (640, 427), 100_000)
VAST = Scene(60, (640, 427), (640, 427), 1_000_000)
# Few pairs connect these photographs: more features are extracted.
KITCHEN = Scene(25, (779, 520), (640, 427), 68_320)
LARGE = Scene(8, (3375, 6000), (360, 640), 20_000)  # fox, enlarged

# Peak memory in MB with two threads and the preset fast, from run.json.
USED = {
    SOUTH_BUILDING: {
        "inspect": 141,
        "features": 484,
        "matches": 267,
        "sfm": 352,
        "undistort": 141,
        "init": 148,
        "train": 711,
    },
    TOWN: {
        "inspect": 153,
        "undistort": 162,
        "init": 147,
        "features": 217,
        "matches": 264,
        "sfm": 399,
        "train": 711,
        "evaluate": 401,
        "coverage": 384,
        "report": 202,
    },
    COLOSSEUM: {"matches": 179, "sfm": 264, "train": 545},
    FOX: {"features": 470, "matches": 210, "sfm": 259, "train": 545},
    LARGE: {"inspect": 369, "features": 580, "undistort": 528},
    KITCHEN: {"features": 252, "matches": 267, "sfm": 200},
    DENSE: {"evaluate": 383, "coverage": 379, "report": 203, "partition": 344},
    VAST: {"evaluate": 737, "coverage": 739, "report": 395, "partition": 979},
}
# The export stage's with exact files alone, and of a process that writes as many Gaussians as SPZ,
# reads them and renders them.
EXPORTED = {TOWN: (139, None), DENSE: (126, 412), VAST: (338, 1533)}


GIVEN = PoseSummary(
    kind="colmap",
    path="sparse/0",
    num_images=125,
    models=("SIMPLE_RADIAL",),
    pinhole=False,
    num_points=60_000,
    tracked=1000,
    centred=True,
)


def plan_of(scene: Scene, config: Config, blocks: int = 1) -> Plan:
    width, height = scene.view
    pixels = scene.photographs * width * height
    facts = FACTS.model_copy(
        update={
            "photographs": scene.photographs,
            "sizes": {f"{scene.size[0]}x{scene.size[1]}": scene.photographs},
            "view_size": scene.view,
            "given_poses": GIVEN if scene.given_model else None,
            "training_memory_mb": round(400 + 3.75e-6 * pixels + 2.5e-3 * scene.gaussians),
        }
    )
    density = config.train.density.model_copy(update={"max_gaussians": scene.gaussians})
    settled = settled_config(config)
    settled = settled.model_copy(
        update={
            "train": settled.train.model_copy(update={"density": density}),
            "partition": settled.partition.model_copy(update={"blocks": blocks}),
        }
    )
    return Plan(scene="x", stages={}, warnings=[], config=settled, facts=facts)


@pytest.mark.parametrize("scene", USED)
def test_jobs_reserve_what_stages_take_and_at_most_half_more(scene: Scene) -> None:
    """Up to four times as much where more features may be extracted, in a second process."""
    plan = plan_of(scene, scene_config({"preset": "fast"}, "x", None, None))
    for stage, used in USED[scene].items():
        spare = 4 if stage in ("matches", "sfm") else 1.5
        assert used <= memory_mb(stage, plan, 2) <= spare * used, stage


@pytest.mark.parametrize("scene", EXPORTED)
def test_exports_reserve_what_they_take(scene: Scene) -> None:
    """The loss of compressed files is measured, which takes several times as much."""
    exact, compressed = EXPORTED[scene]
    for formats, used in ((["ply", "points"], exact), (["ply", "spz"], compressed)):
        config = scene_config({"preset": "fast", "export": {"formats": formats}}, "x", None, None)
        if used is not None:
            assert used <= memory_mb("export", plan_of(scene, config), 2) <= 1.5 * used, formats


@pytest.mark.parametrize(("gaussians", "used"), [(131_072, 350), (300_000, 354)])
def test_levels_of_detail_reserve_what_the_largest_chunk_takes(gaussians: int, used: int) -> None:
    scene = Scene(20, (640, 480), (640, 480), gaussians)
    for name in ("sog_lod", "tiles3d"):
        config = Config.model_validate({"export": {"formats": [name]}})
        assert used <= memory_mb("export", plan_of(scene, config), 2) <= 1.5 * used, name


def test_maps_reserve_what_their_cloud_takes() -> None:
    """A cloud of 2.8 million points, where the plan expects the most that there can be."""
    scene = Scene(75, (1296, 972), (640, 480), 76_800)
    config = Config.model_validate({"export": {"formats": ["ply", "ortho", "laz"]}})
    assert 800 <= memory_mb("export", plan_of(scene, config), 2) <= 2.2 * 800


def test_jobs_that_estimate_depth_maps_reserve_what_they_take() -> None:
    """With one thread; 28 of 32 and 21 of 25 photographs are training views."""
    config = Config.model_validate({"preset": "fast", "init": {"method": "dense"}})
    demo = Scene(32, (480, 360), (480, 360), 43_200)
    church = Scene(25, (1152, 768), (640, 427), 68_320)
    for scene, dense, init in ((demo, 265, 153), (church, 275, 157)):
        thinned = config.init.model_copy(update={"max_points": scene.gaussians // 2})
        plan = plan_of(scene, config.model_copy(update={"init": thinned}))
        assert dense <= memory_mb("dense", plan, 1) <= 1.6 * dense
        assert init <= memory_mb("init", plan, 1) <= 2 * init


def test_jobs_of_a_large_scene_reserve_what_they_take() -> None:
    """The town of 300 photographs in three jobs, with two threads."""
    town = Scene(300, (640, 427), (640, 427), 100_000)
    plan = plan_of(town, Config.model_validate({"features": {"photos_per_job": 100}}))
    used = {"extract": 211, "features": 141, "pairs": 237, "match": 243, "matches": 154}
    for stage, megabytes in used.items():
        assert megabytes <= memory_mb(stage, plan, 2) <= 1.6 * megabytes, stage


def test_jobs_of_a_scene_in_blocks_reserve_what_they_take() -> None:
    """Aerial photographs, a building with views of the same size, and a town, in four blocks, with
    two threads: the coarse run, and the largest block of each round."""
    aerial, town = (75, (4000, 3000)), (300, (640, 427))
    for (count, size), view, gaussians, used in (
        (aerial, (800, 600), 240_000, {"coarse": 621, "block": 583, "polish": 637}),
        (aerial, (640, 480), 76_800, {"coarse": 439, "block": 480, "polish": 485}),
        (town, (640, 427), 68_320, {"coarse": 457, "block": 415, "polish": 440}),
    ):
        plan = plan_of(Scene(count, size, view, gaussians), Config(), blocks=4)
        for stage, megabytes in used.items():
            assert megabytes <= memory_mb(stage, plan, 2) <= 1.5 * megabytes, stage


def test_the_memory_of_matches_does_not_grow_with_large_scenes() -> None:
    few, many = (
        plan_of(Scene(count, (640, 427), (640, 427), 100_000), Config.model_validate(CHUNKS))
        for count in (1000, 4000)
    )
    for stage in ("extract", "match"):
        assert memory_mb(stage, many, 2) < 1.3 * memory_mb(stage, few, 2)


CHUNKS = {"features": {"photos_per_job": 250}}


def test_more_threads_and_larger_photographs_take_more() -> None:
    config = Config()
    for stage in ("inspect", "features", "undistort"):
        assert memory_mb(stage, plan_of(LARGE, config), 8) > memory_mb(
            stage, plan_of(LARGE, config), 2
        )
        assert memory_mb(stage, plan_of(LARGE, config), 2) > memory_mb(
            stage, plan_of(FOX, config), 2
        )


def test_a_limit_of_memory_limits_threads_and_requests() -> None:
    config = Config.model_validate({"partition": {"memory_mb": 700}})
    free, limited = plan_of(LARGE, Config()), plan_of(LARGE, config)
    for stage in STAGES:
        assert threads_within(stage, free, 8) == 8
        threads = threads_within(stage, limited, 8)
        assert memory_mb(stage, limited, 8) <= 700
        if threads > 1:
            assert memory_mb(stage, free, threads) <= 700
        if threads < 8:
            assert memory_mb(stage, free, threads + 1) > 700
    assert 1 < threads_within("undistort", limited, 8) < 8
    # One photograph needs more, and the job gets what is allowed.
    assert threads_within("features", limited, 8) == 1


def test_every_stage_has_an_estimate() -> None:
    for stage in STAGES:
        assert memory_mb(stage, plan_of(FOX, Config()), 1) > 100
