"""Hostile input through Snakemake, and remedies followed to the letter."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.e2e import transcripts
from tests.e2e.harness import (
    TINY,
    command,
    copy_run,
    environment,
    metrics,
    rules_run,
    snakemake,
)

pytestmark = pytest.mark.slow

TARGET = "results/tiny/metrics.json"


@pytest.fixture
def project(finished, tmp_path) -> Path:
    return copy_run(finished, tmp_path / "project")


def test_the_remedy_for_a_damaged_file_makes_it_again(project, finished):
    damaged = project / "results" / "tiny" / "train" / "gaussians.npz"
    whole = damaged.read_bytes()
    data = bytearray(whole)
    data[len(data) // 2] ^= 0xFF
    damaged.write_bytes(data)
    formats = {"export": {"formats": ["ply"]}}
    done = snakemake(project, TARGET, config=TINY | formats, check=False)
    said = done.stdout
    assert done.returncode != 0 and "Traceback" not in said and "what to do" in said
    assert "train/gaussians.npz: has changed since stage train wrote it" in said
    (advice,) = set(re.findall(r"as in: snakemake --cores all (.*)", said))
    snakemake(project, *advice.split(), config=TINY)
    assert damaged.read_bytes() == whole
    assert metrics(project, "tiny") == metrics(finished, "tiny")


def test_a_deleted_report_is_made_again_by_the_next_batch(project):
    snakemake(project, config=TINY)
    page = project / "results" / "tiny" / "report.html"
    page.unlink()
    done = snakemake(project, config=TINY)
    assert "report" in rules_run(done) and "train" not in rules_run(done)
    assert page.is_file()


def test_results_from_the_future_change_nothing(project, finished):
    """As after a clock that was set back."""
    later = time.time() + 10 * 86400
    os.utime(project / "results" / "tiny" / "undistort" / "stage.json", (later, later))
    done = snakemake(project, TARGET, config=TINY)
    assert not rules_run(done) or "train: up to date, nothing to do" in done.stderr
    assert metrics(project, "tiny") == metrics(finished, "tiny")


def test_an_interrupted_training_leaves_no_traceback_and_no_half_output(project):
    (project / "results" / "tiny" / "train" / "stage.json").unlink()
    progress = project / "results" / "tiny" / ".scratch" / "progress" / "train.json"
    progress.unlink()
    long = TINY | {"train": TINY["train"] | {"steps": 50_000}}
    process = subprocess.Popen(
        command(TARGET, config=long),
        cwd=project,
        env=environment(project),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        # As in a terminal, also where the tests run in the background of a shell.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 200
    while not progress.exists() or '"training"' not in progress.read_text():
        assert process.poll() is None, "snakemake ended before the training"
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert list(project.glob("results/tiny/.scratch/train/*/out"))
    os.killpg(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 130
    transcripts.check("interrupted", said, lines=15)
    assert "Traceback" not in said, said
    assert not list(project.glob("results/tiny/.scratch/train/*/out"))
