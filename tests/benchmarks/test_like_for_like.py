"""Published figures stand beside own ones of the same protocol, and beside no others."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any

import pytest

from benchmarks.like_for_like import like_for_like, own_figures
from benchmarks.measured import measured
from benchmarks.results import BudgetResult
from pipeline.plan.protocols import PUBLISHED_SCENES
from pipeline.reporting.batch import PUBLISHED
from tests.benchmarks.test_budgets import POINT

LEGO = replace(POINT, psnr=34.567, minutes=8.0, deviations=[])


def record(*points: BudgetResult) -> dict[str, Any]:
    facts = measured("budgets", "", []).model_dump()
    return {**facts, "results": [asdict(point) for point in points]}


def rows(*points: BudgetResult) -> list[list[str]]:
    lines = like_for_like([record(*points)] if points else []).splitlines()[2:]
    return [line.strip("| ").split(" | ") for line in lines]


def test_without_own_figures_there_are_dashes() -> None:
    ours = [row for row in rows() if row[1] == "splatmake"]
    assert [row[0] for row in ours] == [
        *("Mip-NeRF 360, mean of 9", "Tanks and Temples, mean of 2"),
        *("Deep Blending, mean of 2", "NeRF-synthetic, mean of 8"),
    ]
    assert all(set(row[2:]) == {"-"} for row in ours)


def test_a_scene_that_was_measured_as_published_is_shown_with_its_peers() -> None:
    found = [row for row in rows(LEGO, replace(LEGO, minutes=4.0)) if row[0].startswith("lego")]
    assert found[0][1:5] == ["**splatmake, 8 minutes**", "34.57", "0.950", "-"]
    assert {row[1] for row in found[1:]} == {"3DGS, 30k steps", "3DGS-MCMC"}
    assert sorted(row[2] for row in found[1:]) == ["35.78", "36.01"]


@pytest.mark.parametrize(
    "point",
    [
        POINT,
        replace(LEGO, benchmark=None, published_scene=None),
        replace(LEGO, trainer="OpenSplat 1.2"),
    ],
)
def test_other_protocols_scenes_and_trainers_are_not_shown(point: BudgetResult) -> None:
    assert rows(point) == rows()


def test_a_mean_needs_all_scenes_of_its_benchmark() -> None:
    names = [s.scene for s in PUBLISHED_SCENES.values() if s.benchmark == "NeRF-synthetic"]
    found = [replace(LEGO, published_scene=name, psnr=30.0 + i) for i, name in enumerate(names)]
    mean = next(row for row in rows(*found) if row[0].startswith("NeRF-synthetic, mean"))
    assert mean[1:3] == ["**splatmake, 8 minutes**", "33.50"]
    (mean,) = [r for r in rows(*found[1:]) if r[0].startswith("NeRF-synthetic") and r[2] == "-"]
    assert mean[1] == "splatmake"


def test_scenes_of_records_count_as_well() -> None:
    published = {"benchmark": "NeRF-synthetic", "scene": "lego", "deviations": ()}
    run = {"psnr": 33.0, "ssim": 0.97, "lpips": 0.03, "gaussians": 2e5, "cpu_s": {"train": 600.0}}
    scene = {
        "kind": "scene", "training": "preset high", "cores": 2, "instruction_set": "x86-64-v4",
        "protocol": {"published": published}, "runs": [run],
    }  # fmt: skip
    (figure,) = own_figures(scene)
    assert (figure.method, figure.lpips, figure.minutes) == ("splatmake, preset high", 0.03, 10.0)
    assert own_figures(scene | {"protocol": {}}) == []


def test_published_rows_name_their_source_and_differing_ones_are_left_out() -> None:
    entries = json.loads(PUBLISHED.read_text())["results"]
    for entry in entries:
        assert entry["address"].startswith("https://") and entry["table"] and "differs" in entry
    differing = {e["method"] for e in entries if e["differs"]}
    assert {"Mip-Splatting", "3DGS-MCMC"} <= differing
    shown = {(row[0].split(",")[0], row[1]) for row in rows()}
    assert ("Mip-NeRF 360", "Mip-Splatting") not in shown
    assert ("NeRF-synthetic", "3DGS-MCMC") in shown
