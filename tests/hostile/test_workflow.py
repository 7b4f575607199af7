"""Hostile input through Snakemake, and remedies followed to the letter."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.e2e.harness import (
    TINY,
    command,
    copy_run,
    environment,
    make_project,
    metrics,
    rules_run,
    snakemake,
)
from tests.videos import texture

pytestmark = pytest.mark.slow

TARGET = "results/tiny/metrics.json"


@pytest.fixture
def project(finished, tmp_path) -> Path:
    return copy_run(finished, tmp_path / "project")


def fails(project: Path, *args: str, config: dict | None = TINY) -> str:
    done = snakemake(project, *args, config=config, check=False)
    assert done.returncode != 0 and "Traceback" not in done.stdout, done.stdout
    assert "what to do" in done.stdout
    return done.stdout


@pytest.mark.parametrize("file", ["train/gaussians.npz", "undistort/images/view_000.png"])
def test_the_remedy_for_a_damaged_file_makes_it_again(project, finished, file):
    damaged = project / "results" / "tiny" / file
    whole = damaged.read_bytes()
    data = bytearray(whole)
    data[len(data) // 2] ^= 0xFF
    damaged.write_bytes(data)
    said = fails(project, TARGET, config=TINY | {"export": {"formats": ["ply"]}})
    stage = file.split("/")[0]
    assert f"{file}: has changed since stage {stage} wrote it" in said
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


def test_clocks_that_were_set_back(project, finished):
    """Photographs and results from the future change nothing."""
    later = time.time() + 10 * 86400
    for photo in (project / "data" / "tiny" / "images").iterdir():
        os.utime(photo, (later, later))
    assert rules_run(snakemake(project, TARGET, config=TINY)) == set()
    os.utime(project / "results" / "tiny" / "undistort" / "stage.json", (later, later))
    done = snakemake(project, TARGET, config=TINY)
    assert not rules_run(done) or "train: up to date, nothing to do" in done.stdout
    assert metrics(project, "tiny") == metrics(finished, "tiny")


def test_an_interrupted_training_leaves_no_traceback_and_no_half_output(project):
    (project / "results" / "tiny" / "train" / "stage.json").unlink()
    progress = project / "results" / "tiny" / ".scratch" / "progress.json"
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
    while not progress.exists():
        assert process.poll() is None, "snakemake ended before the training"
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert list(project.glob("results/tiny/.scratch/train/*/out"))
    os.killpg(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=120)
    assert process.returncode != 0
    assert "Traceback" not in said, said
    assert not list(project.glob("results/tiny/.scratch/train/*/out"))


def test_a_configuration_in_utf_16(project):
    (project / "config" / "config.yaml").write_bytes("preset: fast\n".encode("utf-16"))
    said = fails(project, "-n", TARGET, config=None)
    assert "config/config.yaml: expected text in UTF-8" in said


def test_photographs_that_overlap_by_two_pixels(tmp_path):
    project = make_project(tmp_path / "project")
    folder = project / "data" / "strip"
    folder.mkdir(parents=True)
    wide = texture(size=(160 * 4, 120))
    for i in range(4):
        Image.fromarray(np.ascontiguousarray(wide[:, 158 * i : 158 * i + 160])).save(
            folder / f"{i}.png"
        )
    said = fails(project, "results/strip/metrics.json")
    assert "of strip" in said
    assert not (project / "results" / "strip" / "sfm").exists()
