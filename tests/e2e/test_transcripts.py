"""What a user reads in the terminal: whole runs, word by word.

Those of a batch, of Ctrl-C and of a cluster are compared where such runs are tested.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pipeline.runtime.progress import ProgressState, progress_text
from tests.e2e import transcripts
from tests.e2e.conftest import FIRST_RUN
from tests.e2e.harness import TINY, copy_run, make_project, snakemake
from tests.e2e.test_bad_input import noise

pytestmark = pytest.mark.slow

TARGET = "results/tiny/metrics.json"


def test_the_first_run(finished: Path) -> None:
    transcripts.check("first_run", (finished / FIRST_RUN).read_text(), lines=40)


@pytest.mark.parametrize("note", ["", "1,234 Gaussians, PSNR 20.1 dB"])
@pytest.mark.parametrize("done", [1, 200])
def test_lines_that_depend_on_the_speed_are_left_out(note: str, done: int) -> None:
    state = ProgressState(
        label="training, block 2",
        done=done,
        total=240,
        unit="steps",
        rate=1.0,
        seconds_left=90.0,
        note=note,
    )
    kept = "tiny: 20 photographs\n  warning: 1 of 20 photographs is blurred\n"
    shown = f"  train      {progress_text(state)}\n  sfm 2      running\n"
    assert transcripts.masked(kept + shown) == transcripts.masked(kept)


def test_a_second_run_and_a_dry_run_of_a_finished_scene(finished: Path, tmp_path: Path) -> None:
    project = copy_run(finished, tmp_path / "project")
    transcripts.check("second_run", snakemake(project, TARGET, config=TINY).stdout, lines=6)
    dry = snakemake(project, "-n", TARGET, config=TINY).stdout
    transcripts.check("dry_run_of_a_finished_scene", dry, lines=2)


def test_wrong_words(tmp_path: Path) -> None:
    project = make_project(tmp_path / "project")
    noise(project / "data/fog/images", 4)
    for name, target, config in (
        ("wrong_target", "results/fog", TINY),
        ("misspelt_option", "results/fog/metrics.json", {"steps": 100}),
    ):
        done = snakemake(project, "-n", target, config=config, check=False)
        assert done.returncode != 0
        transcripts.check(name, done.stdout, lines=5)


def test_a_stage_that_fails(tmp_path: Path) -> None:
    project = make_project(tmp_path / "project")
    noise(project / "data/fog/images", 4)
    done = snakemake(project, "results/fog/metrics.json", config=TINY, check=False)
    assert done.returncode == 1
    transcripts.check("failed_stage", done.stdout, lines=30)


def test_a_weak_scene(finished: Path, tmp_path: Path) -> None:
    """A third of the photographs show something else."""
    project = make_project(tmp_path / "project")
    shutil.copytree(finished / "data/tiny", project / "data/weak")
    noise(project / "data/weak/images", 10, size=(200, 150))
    done = snakemake(project, "results/weak/metrics.json", config=TINY)
    transcripts.check("weak_scene", done.stdout, lines=40)
