"""Every extreme value of every option gives a plan or one error within two seconds."""

from __future__ import annotations

import time
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.config.load import Project, load_project, scene_config
from pipeline.config.options import sections_of
from pipeline.config.schema import Config
from pipeline.plan import duration, stage_memory
from pipeline.plan.plan import describe
from pipeline.plan.scan import Scan
from pipeline.runtime.errors import UserError
from stages.workflow.registry import STAGES
from tests.plan.scans import many
from tests.plans import make_plan

SECONDS = 2.0
LONG = [0] * 100_000
NUMBERS: list[Any] = [
    *(0, 1, 2, 3, 17, 199, 200, 201, 10_000, 10**6, 10**7, 2**31 - 1, 2**31, 10**18, 10**400),
    *(-1, -(10**30), 0.5, 1e-30, 5e-324, 1e-9, 0.001, 1e5, 1e9, 1e308),
    *(float("nan"), float("inf"), float("-inf")),
]
OTHERS: list[Any] = [
    *(
        "",
        "auto",
        "none",
        "1e308",
        "3e9",
        "3000000000",
        "9" * 5000,
        "nan",
        "\0",
        "\ud800",
        "x" * 9999,
    ),
    *("gpu", "gpu:7", "gpu:99999", "../..", "/", None, True, False, [], {}, LONG, ["ply"] * 999),
    *([[]], {"a": {}}, {"": 1}, {1: 2}, [None], b"bytes"),
]


def leaves(model: Any, prefix: str = "") -> list[str]:
    """Dotted paths of all options."""
    found = []
    for name, field in model.model_fields.items():
        sections = sections_of(field)
        inner = [path for section in sections for path in leaves(section, f"{prefix}{name}.")]
        found += inner or [prefix + name]
    return list(dict.fromkeys(found))


OPTIONS = leaves(Config)


def nested(values: dict[str, Any]) -> dict[str, Any]:
    raw: dict[str, Any] = {}
    for path, value in values.items():
        *sections, option = path.split(".")
        place = raw
        for section in sections:
            place = place.setdefault(section, {})
        place[option] = value
    return raw


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return many(tmp_path_factory.mktemp("scene"), 12)


def check(scene: Scan, values: dict[str, Any]) -> None:
    """Plan the scene, with the estimates that a cluster needs."""
    start = time.process_time()
    try:
        raw = nested(values)
        load_project(raw)
        plan = make_plan(scene, scene_config(raw, "scene"))
        assert describe(plan)
        for stage in STAGES:
            assert duration.minutes(stage, plan) > 0
            assert stage_memory.memory_mb(stage, plan, 2) > 0
    except UserError as error:
        assert len(str(error)) < 3000, "ten lines of at most 200 characters and their values"
    assert time.process_time() - start < SECONDS, values.keys()


@pytest.mark.parametrize("option", [*OPTIONS, *Project.model_fields])
def test_every_extreme_value_of_an_option_is_planned_or_refused(scene: Scan, option: str) -> None:
    for value in NUMBERS + OTHERS:
        check(scene, {option: value})


@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    st.dictionaries(
        st.sampled_from(OPTIONS), st.sampled_from([v for v in NUMBERS if 0 < v < 10**8]), max_size=4
    )
)
def test_extreme_values_together_are_planned_or_refused(
    scene: Scan, values: dict[str, Any]
) -> None:
    check(scene, values)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"train.steps": 3_000_000_000}, "train.steps"),
        ({"train.budget_minutes": "1e308"}, "train.budget_minutes"),
        ({"partition.blocks": 10_000}, "partition.blocks"),
        ({"partition.blocks": 7}, "at most 6 blocks for 12 photographs"),
        ({"export.mesh_voxel": 1e-30}, "export.mesh_voxel"),
        ({"partition.memory_mb": 10}, "partition.memory_mb"),
        ({"seeds": list(range(10**6))}, "seeds"),
        ({"train.device": "gpu:99999"}, "train.device"),
        ({"init.points_file": ""}, "init.points_file"),
    ],
)
def test_an_impossible_value_is_an_error_that_names_the_option(
    scene: Scan, values: dict[str, Any], said: str
) -> None:
    with pytest.raises(UserError, match=said):
        load_project(nested(values))
        make_plan(scene, scene_config(nested(values), "scene"))
