"""The workflow's own jobs on a disk that is full."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.config.schema import Config
from pipeline.plan.plan import plan_record
from pipeline.plan.scan import scan
from tests.pictures import photos
from tests.plans import make_plan

ROOT = Path(__file__).parents[2]


def limited(bytes_per_file: int) -> None:
    """Let writing fail from this size on, as on a full disk."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_per_file, bytes_per_file))


def plan_words(folder: Path) -> list[str]:
    photos(folder / "garden", 3)
    plan = make_plan(scan(folder / "garden", "garden", Config(), cache=None), Config())
    out = folder / "results" / "garden"
    names = ["--out", str(out / "plan.json"), "--picture", str(out / "plan.svg")]
    return ["plan", *names, "--plan", plan_record(plan).model_dump_json()]


def batch_words(folder: Path) -> list[str]:
    lost = {"run": ["garden", "", None], "status": "failed", "stage": "sfm", "message": "no"}
    outcomes = json.dumps({"outcomes": [lost]})
    return ["batch", "--results", str(folder / "results"), "--outcomes", outcomes]


@pytest.mark.parametrize("words", [plan_words, batch_words])
@pytest.mark.parametrize("size", [0, 100, 4000])
def test_a_full_disk_is_one_message(tmp_path: Path, words, size: int) -> None:
    job, *rest = words(tmp_path)
    done = subprocess.run(
        [sys.executable, "-m", f"stages.workflow.{job}", *rest],
        cwd=ROOT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: limited(size),
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert "the disk is full" in done.stderr and "what to do" in done.stderr
    assert str(tmp_path / "results") in done.stderr
    assert not list(tmp_path.glob("results/**/*.tmp"))
