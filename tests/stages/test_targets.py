"""Targets that no rule makes: the message names the one that was probably meant."""

from __future__ import annotations

from pathlib import Path

import pytest
from snakemake.exceptions import MissingRuleException

from stages.workflow.targets import explain_missing_rule, unknown_target

MEANT = {
    "results/door": "results/door/metrics.json",
    "results/door/metric.json": "results/door/metrics.json",
    "results/door/metricsjson": "results/door/metrics.json",
    "results/door/repotr.html": "results/door/report.html",
    "results/door/trian/stage.json": "results/door/train/stage.json",
    "results/dor/metrics.json": "results/door/metrics.json",
    "results/dor@fast@seed1/metrics.json": "results/door@fast@seed1/metrics.json",
    "results/dor": "results/door/metrics.json",
    "result/door/metrics.json": "results/door/metrics.json",
    "door": "results/door/metrics.json",
    "data/door/": "results/door/metrics.json",
    "dor": "results/door/metrics.json",
    "al": "all",
    "results/benchmark.cvs": "results/benchmark.csv",
    "benchmark.csv": "results/benchmark.csv",
    "results/index.htm": "results/index.html",
}


@pytest.mark.parametrize("target", MEANT)
def test_the_target_that_was_meant_is_named(target: str) -> None:
    error = str(unknown_target(target, Path("photos"), ["door", "garden"]))
    assert f"(did you mean {MEANT[target]}?)" in error
    assert error.startswith(f"{target}: ") and "results/benchmark.csv" in error


def test_snakemakes_message_about_a_missing_rule_is_known(tmp_path: Path) -> None:
    (tmp_path / "door").mkdir()
    text = f"MissingRuleException:\n{MissingRuleException('results/dor')}"
    shown = explain_missing_rule(text, tmp_path)
    assert shown.startswith("error: results/dor: there is no scene 'dor'")
    assert "(did you mean results/door/metrics.json?)" in shown
    assert explain_missing_rule("Error in rule train:", tmp_path) == "Error in rule train:"


def test_a_scene_that_is_not_there_is_looked_for_in_data_root() -> None:
    error = str(unknown_target("results/kitchen/metrics.json", Path("photos"), ["door"]))
    assert "there is no scene 'kitchen' in photos" in error and "did you mean" not in error
    assert "did you mean" not in str(unknown_target("", Path("photos"), []))
