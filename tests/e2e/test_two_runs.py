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
from types import SimpleNamespace

import pytest

from stages.workflow.project import SnakemakeProject
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
from tests.stages.flow import dry_run

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
    assert start_pairs(two_scenes(tmp_path / "project"), 2) == []


def test_a_job_that_lost_its_snakemake_goes_on_and_the_next_one_waits(
    project: Path, finished: Path
) -> None:
    (project / "results/tiny/metrics.json").unlink()
    shutil.rmtree(project / "results/tiny/evaluate")
    ready = "results/tiny/.scratch/evaluate/*/out"
    start_and_kill(project, TARGET, ready, config=TINY, only_snakemake=True)
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
    first = start_snakemake(project, TARGET, config=TINY)
    lock = project / "results/tiny/.scratch/run.lock"
    while not lock.is_file() or f"process {first.pid}\n" not in lock.read_text():
        assert first.poll() is None
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


def test_two_batches_do_not_write_the_tables_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The tables are in one folder, even if the batches have no run in common."""
    monkeypatch.chdir(tmp_path)
    held = Path("results/.scratch/run.lock")
    held.parent.mkdir(parents=True)
    tables = SimpleNamespace(wildcards=SimpleNamespace(), output=["results/benchmark.csv"])
    dag = SimpleNamespace(needrun_jobs=lambda: [tables])
    with open(held, "w") as lock:
        lock.write("someone on a machine, process 1\n")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(SystemExit):
            SnakemakeProject({}, dry_run(dag=dag, scheduler=SimpleNamespace())).before_jobs()
    said = capfd.readouterr().err
    assert "results: another run is writing these results (someone" in said


def test_deleted_output_is_made_again(project: Path, finished: Path) -> None:
    """Snakemake alone says "Nothing to be done" if an intermediate output is missing."""
    after_training = {"train", "evaluate", "coverage", "export", "report"}
    results = project / "results" / "tiny"
    aside = project / "aside"
    for lost, rerun in (
        ("train", after_training),
        ("train/gaussians.npz", after_training),
        ("export", {"export", "report"}),
    ):
        (results / lost).rename(aside)
        planned = snakemake(project, "-n", TARGET, config=TINY)
        message = f"results/tiny/{lost} is missing: {lost.split('/')[0]} runs again"
        assert planned.stdout.count(message) == 1
        assert rules_run(planned) == rerun
        if lost != "export":
            aside.rename(results / lost)
    earlier = "results/tiny/init/stage.json"
    assert rules_run(snakemake(project, "-n", earlier, config=TINY)) == set()
    snakemake(project, TARGET, config=TINY)
    assert model_digests(project, "tiny") == model_digests(finished, "tiny")
    assert rules_run(snakemake(project, "-n", TARGET, config=TINY)) == set()
