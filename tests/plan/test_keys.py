"""Which stages compute on a GPU, and what their keys hold then."""

from __future__ import annotations

import json

from pipeline.config.schema import Config
from pipeline.plan.keys import stage_key, uses_gpu
from stages.workflow.registry import STAGES
from tests.plans import full_plan

ON_GPU = Config.model_validate({"train": {"device": "gpu:0"}})
RENDERING = {
    *("coarse", "partition", "block", "polish", "train"),
    *("holes", "evaluate", "coverage", "export"),
}


def test_stages_that_render_use_the_gpu() -> None:
    for config, expected in ((ON_GPU, RENDERING), (Config(), set())):
        plan = full_plan(config)
        assert {name for name, spec in STAGES.items() if uses_gpu(spec, plan)} == expected


def test_keys_hold_the_kernels_of_a_gpu_only_where_it_is_used() -> None:
    plan, plain = full_plan(ON_GPU), full_plan(Config())
    for name in ("train", "evaluate"):
        key, other = (json.loads(stage_key(STAGES[name], p)) for p in (plan, plain))
        assert key["gpu_source"] and "wgpu" in key["packages"]
        assert "gpu_source" not in other and "wgpu" not in other["packages"]
        assert key["source"] == other["source"]
    assert stage_key(STAGES["features"], plan) == stage_key(STAGES["features"], plain)
