"""Declarations of stages: keys, order, and the options that they can read."""

import subprocess
import sys
from typing import Any

import pytest

from pipeline.config.docs import COUNTERS
from pipeline.config.options import option_paths, select
from pipeline.config.schema import Split, Views
from pipeline.config.settled import Config, Train
from pipeline.plan.keys import stage_key
from pipeline.plan.plan import upstream
from pipeline.plan.record import PlanRecord
from pipeline.plan.values import Plan
from pipeline.runtime.section import read_section
from stages.workflow.registry import STAGES
from tests.plans import full_plan

NOT_IN_KEYS = ("partition.memory_mb", "features.photos_per_job")


def differing(one: Plan, two: Plan) -> set[str]:
    """Stages whose keys differ between two plans."""
    return {s for s, spec in STAGES.items() if stage_key(spec, one) != stage_key(spec, two)}


def changed(config: Config, path: str) -> Config:
    """``config`` with another valid value for the option at ``path``."""
    if path == "train.density.strategy":
        return Config.model_validate({"train": {"density": {"strategy": "mcmc"}}})
    *sections, option = path.split(".")
    section: Any = config
    for name in sections:
        section = getattr(section, name)
    old = getattr(section, option)
    candidates = [not old] if isinstance(old, bool) else []
    if isinstance(old, int | float) and not isinstance(old, bool):
        candidates += [old + 1, old * 1.5, old / 2, old - 1, 0.25]
    if isinstance(old, tuple):
        candidates.append(old[:1])
    candidates += [
        *_literals(type(section).model_fields[option].annotation),
        0.5,
        1,
        64,
        "another",
        "gpu:1",
    ]
    for value in candidates:
        if value == old:
            continue
        nested: dict[str, Any] = {option: value}
        for name in reversed(sections):
            nested = {name: nested}
        try:
            new = Config.model_validate(_merge(config.model_dump(), nested))
        except ValueError:
            continue
        return new
    raise AssertionError(f"no other value found for {path}")


def _literals(kind: Any) -> list[Any]:
    values = getattr(kind, "__args__", ())
    return [v for v in values if isinstance(v, str | int | float)] + [
        inner for v in values for inner in _literals(v)
    ]


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    return {
        k: _merge(base[k], over[k]) if isinstance(over.get(k), dict) else over.get(k, base[k])
        for k in base
    }


@pytest.mark.parametrize("path", list(option_paths()))
def test_an_option_reruns_exactly_the_stages_that_declare_it(path):
    declaring = {
        name
        for name, spec in STAGES.items()
        if any(path == declared or path.startswith(f"{declared}.") for declared in spec.options)
    }
    if path == "seed":
        declaring = {name for name, spec in STAGES.items() if spec.seeded}
    base = Config()
    assert differing(full_plan(base), full_plan(changed(base, path))) == declaring
    assert declaring or path == "preset", f"no stage declares {path}"


@pytest.mark.parametrize("path", NOT_IN_KEYS)
def test_an_option_that_changes_no_result_is_in_no_key(path):
    assert path not in set(option_paths())
    base = Config()
    section, _, option = path.partition(".")
    limited = Config.model_validate({section: {option: 500}})
    assert differing(full_plan(base), full_plan(limited)) == set()


def test_an_undeclared_option_cannot_be_read():
    selected = select(Config(), ("train.sh_degree", "views"))
    train = read_section(Train, selected["train"])
    assert train.sh_degree == 3
    with pytest.raises(AttributeError, match="steps"):
        _ = train.steps
    with pytest.raises(AttributeError, match="max_gaussians"):
        _ = train.density.max_gaussians
    assert read_section(Views, selected["views"]) == Views()
    with pytest.raises(KeyError):
        select(Config(), ("train.no_such_option",))
    # A whole section is an object of the schema.
    whole = select(Config(), ("train", "split"))
    assert read_section(Train, whole["train"]) == Train()
    assert read_section(Split, whole["split"]) == Split()


def test_stages_come_after_their_inputs():
    names = list(STAGES)
    assert names[0] == "inspect" and names[-1] == "report"
    for name, spec in STAGES.items():
        assert name == spec.name
        for candidates in spec.inputs.values():
            assert all(names.index(source) < names.index(name) for source in candidates)


def test_runs_with_different_seeds_share_stages_that_are_not_seeded():
    seeded = {name for name, spec in STAGES.items() if spec.seeded}
    assert differing(full_plan(Config()), full_plan(Config(seed=1))) == seeded


def test_configurations_share_the_stages_before_their_difference():
    """The stages after it read options of train as well."""
    other = Config.model_validate({"train": {"sh_degree": 0}})
    blocks = {"coarse", "partition", "block", "polish"}
    after = blocks | {"train", "holes", "evaluate", "coverage", "export", "report"}
    # The report does not read this option.
    assert differing(full_plan(Config()), full_plan(other)) == after - {"report"}


def test_runs_with_equal_options_share_all_stages_but_the_report():
    assert differing(full_plan(Config()), full_plan(Config(), "fox@copy")) == {"report"}


def test_the_plan_lists_each_stages_inputs():
    plan = full_plan(Config())
    assert plan.stages["evaluate"].inputs == ["inspect", "sfm", "train", "undistort"]
    for name, spec in STAGES.items():
        assert set(plan.stages[name].inputs) == set(upstream(spec, plan).values())


def test_declarations_import_nothing_heavy():
    """The Snakefile imports all declarations before any job starts."""
    heavy = ("torch", "cv2", "pycolmap", "scipy", "skimage", "rawpy")
    code = (
        "import sys; import stages.workflow.registry; "
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_tables_of_a_batch_need_no_torch():
    """They are made again whenever a run has finished; importing torch takes longer."""
    code = "import sys; import stages.workflow.batch; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_the_schema_of_counters_has_the_model_that_each_stage_declares():
    declared = {name: spec.counters for name, spec in STAGES.items()}
    assert {n: f"{m.__module__}:{m.__name__}" for n, m in declared.items()} == COUNTERS


@pytest.mark.parametrize("model", [spec.counters for spec in STAGES.values()] + [PlanRecord])
def test_every_field_of_counters_and_plan_has_a_description(model):
    for part in (schema := model.model_json_schema(), *schema.get("$defs", {}).values()):
        for name, field in part.get("properties", {}).items():
            assert field.get("description", "").endswith("."), f"{part['title']}.{name}"
