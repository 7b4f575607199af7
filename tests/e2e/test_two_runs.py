"""Two runs in one folder, and runs after one that was killed."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.e2e.harness import (
    TINY,
    command,
    copy_run,
    environment,
    model_digests,
    rules_run,
    snakemake,
    start_and_kill,
    start_snakemake,
)
from tests.e2e.starts import start_pairs, two_scenes

pytestmark = pytest.mark.slow

TARGET = "results/tiny/metrics.json"


@pytest.fixture
def project(finished: Path, tmp_path: Path) -> Path:
    return copy_run(finished, tmp_path / "project")


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_two_scenes_started_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    assert start_pairs(two_scenes(tmp_path / "project"), 4) == []


@pytest.mark.parametrize("profile", [(), ("--workflow-profile", "profiles/ci"), ("none",)])
def test_lock_files_of_a_dead_snakemake_block_nothing(
    tmp_path: Path, profile: tuple[str, ...]
) -> None:
    project = two_scenes(tmp_path / "project")
    target = "results/garden/plan.json"
    if profile == ("none",):
        (project / "own").mkdir()
        (project / "own/config.yaml").write_text("keep-going: true\n")
        profile = ("--workflow-profile", "own")
    locks = project / ".snakemake" / "locks"
    locks.mkdir(parents=True)
    for kind in ("input", "output"):
        (locks / f"0.{kind}.lock").write_text(f"{target}\n")
    assert "locked" not in snakemake(project, "-n", target, *profile).stdout
    snakemake(project, target, *profile)
    assert (project / target).is_file()
    snakemake(project, target, "--unlock", *profile)
    assert not list(project.glob(".snakemake/locks/*"))


@pytest.mark.parametrize("only_snakemake", [False, True], ids=["with its job", "alone"])
def test_kill_9_and_the_same_command_continues(
    project: Path, finished: Path, only_snakemake: bool
) -> None:
    """A job that lost its Snakemake goes on; the new one waits for its stage."""
    (project / "results/tiny/metrics.json").unlink()
    shutil.rmtree(project / "results/tiny/evaluate")
    ready = "results/tiny/.scratch/evaluate/*/out"
    start_and_kill(project, TARGET, ready, config=TINY, only_snakemake=only_snakemake)
    done = snakemake(project, TARGET, config=TINY)
    assert "evaluate" in rules_run(done) and "train" not in rules_run(done)
    assert model_digests(project, "tiny") == model_digests(finished, "tiny")


def test_a_closed_terminal_and_the_same_command_continues(project: Path) -> None:
    """The terminal sends SIGHUP to Snakemake and to its job, which ends with a message."""
    (project / TARGET).unlink()
    shutil.rmtree(project / "results/tiny/train")
    logs = project / "results/tiny/logs"
    log, progress = (logs / name for name in ("train.log", "train.metrics.jsonl"))
    for file in (log, progress):
        file.unlink()
    # Not in a fork: its job would end with the process that represents it.
    with subprocess.Popen(
        command(TARGET, config=TINY),
        cwd=project,
        env=environment(project),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        # Tests that run under nohup would hand on that SIGHUP is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    ) as run:
        # Not in the imports before the first step, which may drop an exception.
        wait_until(lambda: progress.is_file() and progress.stat().st_size > 0)
        os.killpg(run.pid, signal.SIGHUP)
    wait_until(lambda: "terminated" in log.read_text())
    assert "Traceback" not in log.read_text()
    done = snakemake(project, TARGET, config=TINY)
    assert "train" in rules_run(done)


def test_the_second_run_of_a_scene_is_refused_with_the_name_of_the_first(
    project: Path, finished: Path
) -> None:
    shutil.rmtree(project / "results/tiny/export")
    with open(os.devnull, "w") as nothing:
        first = start_snakemake(project, TARGET, output=nothing.fileno(), config=TINY)
    lock = project / "results/tiny/.scratch/run.lock"
    while not lock.is_file() or f"process {first.pid}\n" not in lock.read_text():
        assert not first.ended()
        time.sleep(0.01)
    os.killpg(first.pid, signal.SIGSTOP)
    try:
        second = snakemake(project, TARGET, config=TINY, check=False)
    finally:
        os.killpg(first.pid, signal.SIGCONT)
    assert second.returncode == 2 and "Traceback" not in second.stdout
    assert f"another run is writing these results ({lock.read_text().strip()})" in second.stdout
    assert first.wait() == 0
    assert model_digests(project, "tiny") == model_digests(finished, "tiny")


def test_two_batches_do_not_write_the_tables_at_once(tmp_path: Path) -> None:
    """The tables are in one folder, even if the batches have no run in common."""
    project = two_scenes(tmp_path / "project")
    held = project / "results" / ".scratch" / "run.lock"
    held.parent.mkdir(parents=True)
    with open(held, "w") as lock:
        lock.write("someone on a machine, process 1\n")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = snakemake(project, "results/benchmark.csv", check=False)
    assert done.returncode == 2
    assert "results: another run is writing these results (someone" in done.stdout


@pytest.mark.parametrize(
    "lost, rerun",
    [
        ("train", {"train", "evaluate", "coverage", "export", "report"}),
        ("train/gaussians.npz", {"train", "evaluate", "coverage", "export", "report"}),
        ("export", {"export", "report"}),
    ],
)
def test_deleted_output_is_made_again(
    project: Path, finished: Path, lost: str, rerun: set[str]
) -> None:
    """Snakemake alone says "Nothing to be done" if an intermediate output is missing."""
    path = project / "results" / "tiny" / lost
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()
    message = f"results/tiny/{lost} is missing: {lost.split('/')[0]} runs again"
    planned = snakemake(project, "-n", TARGET, config=TINY)
    assert planned.stdout.count(message) == 1
    assert rules_run(planned) == rerun
    earlier = "results/tiny/init/stage.json"
    assert rules_run(snakemake(project, "-n", earlier, config=TINY)) == set()
    done = snakemake(project, TARGET, config=TINY)
    assert "evaluate: up to date, nothing to do" in done.stdout or "evaluate" not in rerun
    assert model_digests(project, "tiny") == model_digests(finished, "tiny")
    assert rules_run(snakemake(project, "-n", TARGET, config=TINY)) == set()
