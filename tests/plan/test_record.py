"""plan.json: written and read, and refused where it is damaged or foreign."""

import json

import pytest

from pipeline.config.schema import Config
from pipeline.plan.plan import plan_record
from pipeline.plan.record import PlanRecord, read_plan
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from tests.pictures import photos
from tests.plan.scans import plan_of
from tests.plans import full_plan

WHOLE = plan_record(full_plan(Config())).model_dump(mode="json")


def test_a_plan_comes_back_from_its_file(tmp_path):
    photos(tmp_path / "images", 2)
    planned = plan_record(plan_of(tmp_path))
    write_json(tmp_path / "plan.json", planned.model_dump(mode="json"))
    found = read_plan(tmp_path)
    assert found == planned and found.version == 1
    assert found.order[0] == "inspect" and found.facts.photographs == 2


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "Invalid JSON"),
        (json.dumps(WHOLE)[:-40], "Invalid JSON"),
        ("[]", "should be an object"),
        ('{"fox": 1}', "scene: Field required"),
        (json.dumps(WHOLE | {"version": 2}), "version: Input should be 1"),
        (json.dumps(WHOLE | {"facts": {}}), "facts.photographs: Field required"),
        (json.dumps(WHOLE | {"order": ["train"]}), "order does not name"),
        (json.dumps(WHOLE | {"more": 1}), "more: Extra inputs"),
    ],
)
def test_a_damaged_or_foreign_plan_is_one_clear_error(tmp_path, content, said):
    (tmp_path / "plan.json").write_text(content)
    with pytest.raises(UserError) as caught:
        read_plan(tmp_path)
    message = str(caught.value)
    assert f"{tmp_path}/plan.json: cannot be read" in message and said in message
    assert f"{tmp_path}/metrics.json --forcerun plan" in message


def test_a_missing_plan_is_one_clear_error(tmp_path):
    with pytest.raises(UserError, match=r"plan.json: .* is missing\n.*--forcerun plan"):
        read_plan(tmp_path)


def test_a_stage_gets_the_plan_of_the_file():
    """Through its key, which is JSON."""
    assert PlanRecord.model_validate(WHOLE) == plan_record(full_plan(Config()))
