"""The diagram of a plan: running and skipped stages."""

import xml.etree.ElementTree as ET

from pipeline.config.schema import Config
from pipeline.plan.plan import plan_record
from pipeline.plan.record import PlanRecord
from pipeline.reporting.dag import plan_svg
from stages.workflow.registry import STAGES
from tests.plans import CHUNK_STAGES, full_plan

SVG = "{http://www.w3.org/2000/svg}"


def plan(*skipped: str) -> PlanRecord:
    return plan_record(full_plan(Config(), skipped=skipped))


def drawn(found: PlanRecord) -> tuple[dict[str, tuple[float, float]], ET.Element]:
    """Corner of each box by stage."""
    root = ET.fromstring(plan_svg(found))
    boxes = {}
    for group in root.iter(f"{SVG}g"):
        rect, name = group.find(f"{SVG}rect"), group.find(f"{SVG}text")
        assert rect is not None and name is not None
        boxes[name.text] = (float(rect.get("x", "")), float(rect.get("y", "")))
    return boxes, root


def test_every_stage_has_a_box_inside_the_diagram():
    estimation = ("features", "matches", "sfm", *CHUNK_STAGES)
    for skipped in ((), ("decode",), ("decode", *estimation, "undistort")):
        boxes, root = drawn(plan(*skipped))
        assert list(boxes) == list(STAGES)
        assert len(set(boxes.values())) == len(boxes)
        _, _, width, height = map(float, root.get("viewBox", "").split())
        assert all(0 <= x <= width - 92 and 0 <= y <= height - 34 for x, y in boxes.values())


def test_skipped_stages_are_below_with_their_reason():
    boxes, root = drawn(plan("decode", "sfm"))
    assert boxes["decode"][1] == boxes["sfm"][1] > boxes["inspect"][1] == boxes["train"][1]
    groups = {g.find(f"{SVG}text").text: g for g in root.iter(f"{SVG}g")}
    assert groups["decode"].get("class") == "skipped"
    assert "why decode <&" in "".join(t.text for t in groups["decode"].iter(f"{SVG}text"))
    title = groups["train"].find(f"{SVG}title")
    assert title is not None and title.text == "train: why train <&\nso"


def test_arrows_are_the_inputs_without_implied_ones():
    """All run: a chain, and holes beside coverage, before export and report."""
    boxes, root = drawn(plan())
    assert boxes["coverage"][0] == boxes["holes"][0] < boxes["export"][0]
    heads = [p for p in root.iter(f"{SVG}path") if p.get("class") == "head"]
    assert len(heads) == len(STAGES)  # the chain of eleven, around export, and to refine
    assert len([p for p in drawn(plan("decode"))[1].iter(f"{SVG}path")]) == 2 * (len(STAGES) - 1)


def test_a_plan_read_from_its_file_gives_the_same_diagram():
    found = plan("decode")
    alphabetical = found.model_copy(update={"stages": dict(sorted(found.stages.items()))})
    assert plan_svg(alphabetical) == plan_svg(found)
