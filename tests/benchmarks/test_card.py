"""The kit that measures a machine in one command: its record survives parts that fail."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from benchmarks.card import pack, plan, run
from benchmarks.card.parts import Case, Found
from benchmarks.card.plan import PARTS, Part
from benchmarks.card.result import CardResult
from benchmarks.light import first_of, read_scene
from benchmarks.measured import Record
from pipeline.demo.write import DemoSpec, write_demo
from pipeline.io.ply import write_splat_ply
from pipeline.runtime.errors import UserError

CASE = Case(Path(), Path(), Path(), "gpu", 10, (96, 64), 1, 1, 0.0, 1, 10)


def slow(case: Case) -> Found:
    """A part that does not end."""
    time.sleep(600)
    return {}, {}


def broken(case: Case) -> Found:
    """A part with an error."""
    raise ValueError("no such kernel")


@pytest.mark.parametrize(
    ("function", "limit_s", "status", "reason"),
    [
        (slow, 1, "over its time", "longer than"),
        (broken, 100, "failed", "no such kernel"),
    ],
)
def test_a_part_that_cannot_be_measured_says_why(function, limit_s, status, reason) -> None:
    result = run.measure(Part("step", "", function, CASE, limit_s), limit_s)
    assert result.status == status and reason in result.reason and not result.figures


def test_every_part_is_planned_with_its_cases() -> None:
    parts = plan.planned(CASE, [1, 2], [(9, 9), (8, 8)], [20, 60], [1, 2, 4])
    assert {part.name for part in parts} == set(PARTS)
    assert sum(part.name == "step" for part in parts) == 4
    assert [part.case.seconds for part in parts if part.name == "train"] == [20, 60]
    assert [part.case.threads for part in parts if part.name == "processor"] == [1, 2, 4]


def test_a_pack_that_is_too_large_is_an_error(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "a").write_bytes(bytes(2000))
    assert pack.size_mb(tmp_path) == pytest.approx(0.002)
    monkeypatch.setattr(pack, "MOST_MB", 0.001)
    with pytest.raises(UserError, match="at most"):
        pack.size_mb(tmp_path)


def test_a_reduced_measurement_has_every_part(tmp_path: Path, monkeypatch) -> None:
    """On a device in software if there is one; without one, the processor alone is measured."""
    # The parts run in this process, since each process of their own would load torch again.
    monkeypatch.setattr(run, "run_limited", lambda limits, function, case: function(case))
    world = tmp_path / "world"
    write_demo(world, DemoSpec(views=10, width=96, height=64, distortion="none", poses="colmap"), 1)
    export = tmp_path / "export"
    export.mkdir()
    write_splat_ply(export / "point_cloud.ply", first_of(read_scene(world), 0).as_arrays())
    pack.pack_scene(tmp_path / "pack", export, world, views=9)
    file = tmp_path / "record.json"
    sizes = ["--counts", "500", "--sizes", "48x32", "--threads", "1", "--turns", "1"]
    training = ["--seconds", "--steps", "3", "--gaussians", "500"]
    assert run.main([str(tmp_path / "pack"), *sizes, *training, "--json", str(file)]) == 0
    record = Record[CardResult].model_validate(json.loads(file.read_text()))
    found = {result.part: result for result in record.results}
    assert set(found) == set(PARTS) - {"train"}
    assert found["gsplat"].status == "not measured" and "CUDA" in found["gsplat"].reason
    of_gpu = [found[name] for name in ("device", "step", "frames", "bits")]
    assert {result.status for result in of_gpu} in ({"measured"}, {"not measured"})
    assert found["compile"].status == found["processor"].status == "measured"
    if found["bits"].figures:
        assert found["bits"].figures["different_results"] == 0
