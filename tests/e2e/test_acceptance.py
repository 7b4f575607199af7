"""What the guide on CI says about accepting a result, done with the tiny scene."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.runtime.errors import EXIT_NOT_ACCEPTED
from tests.documented import commands
from tests.e2e.harness import ROOT, TINY, copy_run, environment, rules_run, snakemake

pytestmark = pytest.mark.slow

GUIDE = "docs/guides/ci.md"
TARGET = "results/tiny/accepted.json"


@pytest.fixture
def project(finished: Path, tmp_path: Path) -> Path:
    return copy_run(finished, tmp_path / "project")


def test_the_commands_of_the_guide_judge_a_result(project: Path) -> None:
    """In the order of the guide: the judgement that one writes is the baseline of the next."""
    rules = re.search(r"^```yaml\n(.*?)^```", (ROOT / GUIDE).read_text(), re.S | re.M)
    (project / "rules.yaml").write_text(rules[1])
    (project / "expected").mkdir()
    found = []
    for command in commands():
        if command.page != GUIDE or command.words[:2] != ["splatmake", "accept"]:
            continue
        words = [word.replace("results/fox", "results/tiny") for word in command.words[1:]]
        if len(words) > 1:
            done = subprocess.run(
                [sys.executable, "-m", "pipeline", *words],
                cwd=project,
                env=environment(project) | {"PYTHONPATH": os.fspath(ROOT)},
                capture_output=True,
                text=True,
                check=False,
            )
            found.append((done.returncode, done.stdout.splitlines()[-1]))
    accepted = (0, "tiny: accepted")
    assert found == [accepted, accepted, accepted]


def test_a_target_of_snakemake_is_made_only_if_the_result_is_accepted(project: Path) -> None:
    done = snakemake(project, TARGET, config=TINY)
    assert rules_run(done) == {"accept"}
    assert json.loads((project / TARGET).read_text())["accepted"]
    (project / "rules.yaml").write_text("min_psnr: 90\n")
    config = TINY | {"acceptance": "rules.yaml"}
    done = snakemake(project, TARGET, config=config, check=False)
    assert done.returncode == EXIT_NOT_ACCEPTED
    assert "not accepted: PSNR" in done.stdout and "at least 90 dB wanted" in done.stdout
    assert not (project / TARGET).exists()
    page = (project / "results/tiny/report.html").read_text()
    assert '<span class="judgement weak">Not accepted: PSNR' in page


def test_wrong_rules_end_a_run_before_any_stage(project: Path) -> None:
    (project / "rules.yaml").write_text("min_psrn: 20\n")
    config = TINY | {"acceptance": "rules.yaml", "seed": 1}
    done = snakemake(project, "results/tiny/metrics.json", config=config, check=False)
    assert "did you mean min_psnr?" in done.stderr + done.stdout
    assert rules_run(done) == set()
