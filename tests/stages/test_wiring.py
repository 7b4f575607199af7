"""Keys of stages: what a run shares with another one."""

import json
import re
from pathlib import Path

import pytest

from pipeline.config.schema import Config
from pipeline.scene.plan import STAGES, Plan, StagePlan
from stages.wiring import ROLES, SECTIONS, SEEDED, public_plan, stage_key, upstream


def plan(config: Config, scene: str = "fox") -> Plan:
    stages = {name: StagePlan(run=True, reason="so") for name in STAGES}
    facts = {"truth_digest": None}
    return Plan(scene=scene, stages=stages, warnings=[], config=config, facts=facts)


def differing(one: Plan, two: Plan) -> set[str]:
    """Stages whose keys differ between two plans."""
    return {s for s in STAGES if stage_key(s, one, "f", "p") != stage_key(s, two, "f", "p")}


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_that_asks_for_the_seed_has_it_in_its_key(stage):
    source = Path(f"stages/{stage}.py").read_text()
    assert "job.seed" not in source or stage in SEEDED
    key = json.loads(stage_key(stage, plan(Config(seed=7)), "f", "p"))
    assert key["seed"] == (7 if stage in SEEDED else None)


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_has_the_sections_it_asks_for_and_no_others(stage):
    """One too few is a failure, one too many reruns what does not depend on it."""
    source = Path(f"stages/{stage}.py").read_text()
    asked = re.findall(r"job\.section\((?:schema\.)?([A-Z]\w+)\)", source)
    assert {name.lower() for name in asked} == set(SECTIONS[stage])


@pytest.mark.parametrize("stage", STAGES)
def test_what_fills_a_role_is_a_stage(stage):
    for candidates in ROLES[stage].values():
        assert set(candidates) <= set(STAGES)


def test_seeds_share_what_draws_nothing():
    assert differing(plan(Config()), plan(Config(seed=1))) == set(SEEDED)


def test_configurations_share_what_stands_before_their_difference():
    """The stages after it differ by what they read: train's options."""
    changed = Config.model_validate({"train": {"sh_degree": 0}})
    assert differing(plan(Config()), plan(changed)) == {"train", "evaluate", "export", "report"}


def test_runs_share_all_but_the_page_that_names_them():
    one, two = plan(Config()), plan(Config(), "fox@copy")
    assert differing(one, two) == {"report"}


def test_the_plan_says_what_feeds_each_stage():
    shown = public_plan(plan(Config()))
    assert shown["stages"]["train"]["inputs"] == ["init", "undistort"]
    for name in STAGES:
        assert set(shown["stages"][name]["inputs"]) == set(upstream(name, plan(Config())).values())
