"""The sizes that a plan settles: Gaussians, memory, blocks, depths, and jobs of features."""

import pytest

from pipeline.config.schema import Config
from pipeline.plan import stage_memory
from pipeline.plan.plan import input_folders
from pipeline.plan.settle import settle
from pipeline.plan.values import Plan
from pipeline.runtime.errors import UserError
from stages.workflow.registry import STAGES
from tests.pictures import photos, picture
from tests.plan.scans import many, plan_of, posed
from tests.plan.test_scan import config, look
from tests.plans import BLOCK_STAGES, CHUNK_STAGES, make_plan


@pytest.mark.parametrize(
    "count, options, budget",
    [
        (2000, {}, 20_000),  # the minimum
        (2000, {"pixels_per_gaussian": 0.1}, 48_000),
        (100, {"pixels_per_gaussian": 0.1}, 20_000),  # few photographs
        (100, {"pixels_per_gaussian": 0.1, "max_gaussians": 500}, 500),
    ],
)
def test_the_number_of_gaussians_follows_the_pixels(tmp_path, count, options, budget):
    size = {"width": lambda i: 80, "height": lambda i: 60}
    config = Config.model_validate({"train": {"density": options}})
    plan = make_plan(many(tmp_path, count, **size), config)
    assert plan.config.train.density.max_gaussians == budget
    assert plan.config.init.max_points == budget // 2
    assert any(f"at most {budget} Gaussians" in text for text in plan.stages["train"].decisions)
    # Settling is idempotent.
    again = make_plan(many(tmp_path, count, **size), plan.config)
    assert again.config == plan.config


def test_the_published_strategy_is_limited_by_its_maximum_alone(tmp_path):
    config = Config.model_validate({"train": {"density": {"strategy": "original"}}})
    plan = make_plan(many(tmp_path, 30), config)
    assert plan.config.train.density.max_gaussians == 3_000_000


@pytest.mark.parametrize(
    "count, wanted, weight", [(30, "auto", 0.03), (31, "auto", 0.0), (31, 0.5, 0.5), (9, 0.0, 0.0)]
)
def test_few_photographs_get_a_loss_on_the_depths_of_sparse_points(tmp_path, count, wanted, weight):
    sections = {"train": {"depth_loss_weight": wanted}, "init": {"method": "points"}}
    plan = make_plan(many(tmp_path, count), Config.model_validate(sections))
    assert plan.config.train.depth_loss_weight == weight
    assert any("depths" in text for text in plan.stages["train"].decisions) == (
        count != 31 or wanted != "auto"
    )


def test_depths_by_multi_view_stereo_are_used_in_one_block_only(tmp_path):
    """Blocks are trained with sparse points alone."""
    config = Config.model_validate({"init": {"method": "dense"}})
    plan = make_plan(many(tmp_path, 40), config)
    assert plan.config.train.depth_loss_weight == 0.3
    assert any("multi-view stereo" in text for text in plan.stages["train"].decisions)
    blocks = config.partition.model_copy(update={"blocks": 2})
    plan = make_plan(many(tmp_path, 40), config.model_copy(update={"partition": blocks}))
    assert plan.config.train.depth_loss_weight == 0.0
    assert "dense" in plan.stages["init"].inputs and "dense" not in plan.stages["train"].inputs


def test_depth_maps_are_used_with_any_number_of_photographs(tmp_path):
    some = many(
        tmp_path,
        50,
        depth=lambda i: f"depths/{i}.png" if i < 30 else None,
        depth_digest=lambda i: f"{i}" if i < 30 else None,
    )
    plan = make_plan(some, Config())
    assert plan.config.train.depth_loss_weight == 0.3
    assert any("30 depth maps" in text for text in plan.stages["train"].decisions)


def test_a_time_budget_limits_the_number_of_gaussians(tmp_path):
    scan = many(tmp_path, 2000, width=lambda i: 80, height=lambda i: 60)
    train = {"budget_minutes": 0.5, "density": {"pixels_per_gaussian": 0.1}}
    plan = make_plan(scan, Config.model_validate({"train": train}))
    assert plan.config.train.density.max_gaussians == 25_000
    text = "at most 25000 Gaussians: 50000 per minute of 0.5 minutes"
    assert text in plan.stages["train"].decisions


@pytest.mark.parametrize(
    "minutes, budget", [(None, 200_000), (4, 200_000), (15, 750_000), (30, 800_000)]
)
def test_a_large_time_budget_gets_two_gaussians_per_pixel(tmp_path, minutes, budget):
    scan = many(tmp_path, 100, width=lambda i: 800, height=lambda i: 500)
    plan = make_plan(scan, Config.model_validate({"train": {"budget_minutes": minutes}}))
    assert plan.config.train.density.max_gaussians == budget


def test_the_plan_estimates_the_memory_of_training(tmp_path):
    size = {"width": lambda i: 800, "height": lambda i: 500}
    density = {"max_gaussians": 1_000_000, "pixels_per_gaussian": 0.1}
    config = Config.model_validate({"train": {"density": density}})
    plan = make_plan(many(tmp_path, 200, **size), config)
    assert plan.facts.training_memory_mb == 400 + 300 + 2500
    assert "about 3.2 GB of memory" in plan.stages["train"].decisions


def test_a_memory_limit_sends_photographs_to_disk_and_limits_the_number_of_gaussians(tmp_path):
    """200 views need 300 MB in total, 1 000 000 Gaussians 2500 MB."""
    size = {"width": lambda i: 800, "height": lambda i: 500}
    scan = many(tmp_path, 200, **size)
    density = {"max_gaussians": 1_000_000, "pixels_per_gaussian": 0.1}

    def planned(megabytes: int) -> Plan:
        options = {"partition": {"blocks": 1, "memory_mb": megabytes}}
        return make_plan(scan, Config.model_validate(options | {"train": {"density": density}}))

    roomy, tight, small = planned(3200), planned(3199), planned(1400)
    assert "about 3.2 GB of memory" in roomy.stages["train"].decisions
    from_disk = "3.2 GB of memory, as configured: photographs are read from disk"
    assert from_disk in tight.stages["train"].decisions
    assert tight.config.train.density.max_gaussians == 1_000_000
    assert small.config.train.density.max_gaussians == 400_000
    limited = "at most 400000 Gaussians: as many as fit into 1400 MB of memory"
    assert limited in small.stages["train"].decisions
    assert [plan.facts.training_memory_mb for plan in (roomy, tight, small)] == [
        3200,
        3199,
        1400,
    ]
    with pytest.raises(UserError, match=r"partition.memory_mb: 449 MB .* 450 are needed"):
        planned(449)


@pytest.mark.parametrize("count, blocks", [(1000, 1), (1001, 5), (2000, 8)])
def test_scenes_of_many_photographs_are_trained_in_blocks(tmp_path, count, blocks):
    scan = many(tmp_path, count)
    plan = make_plan(scan, Config())
    assert plan.config.partition.blocks == blocks
    assert all(plan.runs(stage) == (blocks > 1) for stage in BLOCK_STAGES)
    folders = plan.stages["polish"].folders("polish")
    assert folders == (["polish"] if blocks == 1 else [f"polish_{i + 1}" for i in range(blocks)])
    chosen = make_plan(scan, Config.model_validate({"partition": {"blocks": 2}}))
    assert chosen.config.partition.blocks == 2 and chosen.stages["block"].jobs == 2


@pytest.mark.parametrize("blocks", [1, 2])
def test_only_an_export_by_block_reads_the_partition(tmp_path, blocks):
    """A scene in one block has none."""
    scan = many(tmp_path, 40)
    for formats, reads in ((["ply"], False), (["ply", "blocks"], blocks == 2)):
        options = {"partition": {"blocks": blocks}, "export": {"formats": formats}}
        plan = make_plan(scan, Config.model_validate(options))
        assert ("partition" in plan.stages["export"].inputs) == reads


def test_blocks_have_no_appearance_embeddings(tmp_path):
    options = {"train": {"appearance": "embedding"}}
    scan = many(tmp_path, 40)
    assert make_plan(scan, Config.model_validate(options)).config.partition.blocks == 1
    with pytest.raises(UserError, match=r"embedding is not available in blocks, .* 2\n") as caught:
        make_plan(scan, Config.model_validate(options | {"partition": {"blocks": 2}}))
    assert "train.appearance: exposure" in str(caught.value)


def test_passers_by_are_searched_for_unless_the_scene_says_otherwise(tmp_path):
    photos(tmp_path / "images", 9)
    options = [{}, {"density": {"strategy": "original"}}, {"transients": "none"}]
    wanted = [settle(look(tmp_path), config(train=o)).config.train.transients for o in options]
    assert wanted == ["find", "none", "none"]
    blocks = config(partition={"blocks": 2})
    assert settle(look(tmp_path), blocks).config.train.transients == "none"
    with pytest.raises(UserError, match="transients: find is not available in blocks"):
        settle(look(tmp_path), config(partition={"blocks": 2}, train={"transients": "find"}))
    picture(tmp_path / "masks" / "p00.png", mode="L")
    settled = settle(look(tmp_path), config())
    assert settled.config.train.transients == "none"
    assert "only what the masks exclude" in settled.why["train.transients"]
    again = settle(look(tmp_path), settled.config)
    assert again.config == settled.config
    forced = config(train={"transients": "find"})
    assert settle(look(tmp_path), forced).config.train.transients == "find"


def test_a_scene_is_divided_until_its_training_fits(tmp_path):
    size = {"width": lambda i: 800, "height": lambda i: 500}
    scan = many(tmp_path, 200, **size)
    train = {"density": {"max_gaussians": 1_000_000, "pixels_per_gaussian": 0.1}}

    def planned(megabytes: int | None) -> Plan:
        options = {"train": train, "partition": {"memory_mb": megabytes}}
        return make_plan(scan, Config.model_validate(options))

    assert planned(None).config.partition.blocks == 1
    whole, divided = planned(3625), planned(3624)
    assert whole.config.partition.blocks == 1
    assert divided.config.partition.blocks == 2
    assert divided.config.train.density.max_gaussians == 1_000_000
    least = planned(1563)
    assert least.config.partition.blocks == 3
    assert "3 blocks, which fit into 1563 MB of memory each" in least.stages["partition"].reason
    for plan, limit in ((divided, 3624), (least, 1563)):
        for stage in ("coarse", "block", "polish"):
            assert stage_memory.memory_mb(stage, plan, 1) <= limit
    with pytest.raises(
        UserError, match=r"1562 MB are not enough .* in any number of blocks; 1563 are needed"
    ):
        planned(1562)
    options = {"train": train, "partition": {"blocks": 2, "memory_mb": 1800}}
    with pytest.raises(UserError, match=r"1800 MB are not enough .* in 2 blocks; \d+ are needed"):
        make_plan(scan, Config.model_validate(options))
    # More blocks than memory requires, for the number of photographs.
    many_photos = make_plan(
        many(tmp_path / "many", 1001), Config.model_validate({"partition": {"memory_mb": 4000}})
    )
    assert many_photos.config.partition.blocks == 5


@pytest.mark.parametrize("count, jobs", [(500, 1), (501, 3), (1000, 4)])
def test_features_and_matches_of_many_photographs_are_several_jobs(tmp_path, count, jobs):
    scan = many(tmp_path, count)
    plan = make_plan(scan, Config())
    assert all(plan.runs(stage) == (jobs > 1) for stage in CHUNK_STAGES)
    for stage in ("extract", "match"):
        folders = plan.stages[stage].folders(stage)
        assert folders == ([stage] if jobs == 1 else [f"{stage}_{i + 1}" for i in range(jobs)])
    assert len(plan.stages["features"].folders("features")) == 1
    assert plan.stages["pairs"].jobs == 1
    if jobs > 1:
        why = f"{jobs} jobs: one for every 250 of {count} photographs"
        assert plan.stages["extract"].decisions == plan.stages["match"].decisions == [why]
        assert set(input_folders(STAGES["features"], plan)) == {
            "photos",
            *(f"extract_{i + 1}" for i in range(jobs)),
        }
    chosen = make_plan(scan, Config.model_validate({"features": {"photos_per_job": 100}}))
    assert chosen.stages["match"].jobs == -(-count // 100)


def test_given_poses_need_no_jobs_of_features(tmp_path):
    scan = posed(tmp_path, tracks=20)
    plan = plan_of(scan, features={"photos_per_job": 1})
    assert not any(plan.runs(stage) for stage in CHUNK_STAGES)
    assert "poses are given" in plan.stages["extract"].reason
