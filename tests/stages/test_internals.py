"""Contracts with Snakemake: each part of it that ``stages.workflow.internals`` uses is as expected.

A run of Snakemake itself, in a folder with lock files of a dead one, reports what ``Flow`` finds.
"""

from __future__ import annotations

import asyncio
import inspect
import io
import json
import logging
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from snakemake.logging import ColorizingTextHandler, logger
from snakemake.settings.types import OutputSettings
from snakemake_interface_logger_plugins.common import LogEvent

from stages.workflow import internals
from stages.workflow.internals import prepare_folder, watch_jobs
from tests.e2e.harness import ROOT, environment

# --- a run ----------------------------------------------------------------------------------------

SNAKEFILE = """
import json
from pathlib import Path
from stages.workflow import internals

flow = internals.Flow(workflow)


class Print:
    def __getattr__(self, name):
        return lambda *args: print("told", name, *args)


internals.listen(workflow, Print())
internals.use_locks_of_runs()
internals.prepare_folder(Path(".snakemake"))


def nothing(wildcards):
    if flow.decides_jobs and config.get("force"):
        flow.force(Path("made.txt"))
    return []


onstart:
    flow.unlimit_rate()
    flow.watch(flow.needed_jobs())
    names = "folder in_job submits_jobs runs_jobs cores cores_option decides_jobs compares_keys "
    names += "is_shown is_verbose is_quiet shows_logs"
    facts = {name: getattr(flow, name) for name in names.split()}
    facts["targets"], facts["log"] = flow.targets(), internals.log_file()
    facts["causes"] = [flow.cause(job) for job in flow.needed_jobs()]
    facts["needed"] = sorted(job.rule.name for job in flow.needed_jobs())
    facts["limiter"] = repr(workflow.scheduler.job_rate_limiter)
    Path("facts.json").write_text(json.dumps(facts))


rule all:
    input: "made.txt"


rule made:
    input: nothing
    output: "made.txt"
    params: text=lambda wildcards: config["text"]
    shell: "echo {params.text} > {output}"
"""


def run_snakemake(folder: Path, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", *words],
        cwd=folder,
        env=environment(ROOT),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0 and "Traceback" not in done.stdout, done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which Snakemake has run beside the lock files of a dead one."""
    folder = tmp_path_factory.mktemp("snakemake")
    (folder / "Snakefile").write_text(SNAKEFILE)
    (folder / "own").mkdir()
    (folder / "own/config.yaml").write_text("keep-going: true\n")
    locks = folder / ".snakemake" / "locks"
    locks.mkdir(parents=True)
    for kind in ("input", "output"):
        (locks / f"0.{kind}.lock").write_text("made.txt\n")
    profile = ("--workflow-profile", "own")
    run_snakemake(folder, "--cores", "2", *profile, "--config", "text=a")
    return folder


def test_a_workflow_has_the_facts_of_the_run(folder: Path) -> None:
    found = json.loads((folder / "facts.json").read_text())
    assert Path(found.pop("folder")).samefile(folder)
    assert found.pop("log").startswith(".snakemake/log/")
    assert found == {
        "in_job": False,
        "submits_jobs": False,
        "runs_jobs": True,
        "cores": 2,
        "cores_option": 2,
        "decides_jobs": True,
        "compares_keys": True,
        "is_shown": True,
        "is_verbose": False,
        "is_quiet": False,
        "shows_logs": False,
        "targets": ["made.txt"],
        "causes": ["", ""],
        "needed": ["all", "made"],
        "limiter": "None",
    }


def test_lock_files_of_a_dead_snakemake_block_nothing_and_can_be_removed(folder: Path) -> None:
    dry = run_snakemake(folder, "-n", "--cores", "1", "--config", "text=a")
    assert "told nothing_to_do True" in dry and "locked" not in dry
    assert len(list(folder.glob(".snakemake/locks/*"))) == 2
    run_snakemake(folder, "--unlock", "--cores", "1", "--config", "text=a")
    assert not list(folder.glob(".snakemake/locks/*"))


def test_a_forced_file_is_made_again(folder: Path) -> None:
    forced = run_snakemake(folder, "-n", "--cores", "1", "--config", "text=a", "force=1")
    assert "told dry_run" in forced


def test_changed_params_run_a_job_again_unless_only_times_are_compared(folder: Path) -> None:
    words = ("-n", "--cores", "1", "--config", "text=b")
    assert "told dry_run" in run_snakemake(folder, *words)
    assert "told nothing_to_do True" in run_snakemake(folder, *words, "--rerun-triggers", "mtime")


def test_snakemake_migrates_a_folder_without_incomplete(tmp_path: Path) -> None:
    from snakemake.persistence import file

    source = inspect.getsource(file)
    assert "migrate_v1_to_v2()" in source and '"incomplete"' in source
    prepare_folder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["incomplete"]
    (tmp_path / "incomplete").rmdir()
    (tmp_path / "metadata").mkdir()
    prepare_folder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["metadata"]


# --- executors ------------------------------------------------------------------------------------


class Executor:
    """Reports the end of one job, returns another as active, and forgets the others."""

    def __init__(self):
        self.ended: list[str] = []
        self.next_seconds_between_status_checks = 5

    def report_job_success(self, job):
        self.ended.append(job)

    report_job_error = report_job_success

    async def check_active_jobs(self, active):
        for job in active:
            if job == "finished":
                self.report_job_success(job)
            elif job == "failed":
                self.report_job_error(job)
            elif job == "running":
                yield job
        self.next_seconds_between_status_checks += 10


def test_jobs_without_a_status_stay_active():
    """An executor that forgets them would never report their end."""
    executor = Executor()
    watch_jobs(executor, 20)

    async def check(*jobs: str) -> list[str]:
        return [job async for job in executor.check_active_jobs(jobs)]

    active = asyncio.run(check("finished", "running", "unknown", "failed"))
    assert active == ["running", "unknown"]
    assert executor.ended == ["finished", "failed"]


def test_intervals_grow_with_the_age_of_the_jobs_and_are_bounded(monkeypatch):
    """The executor's own interval grows by 10 s with each check."""
    now = 1000.0
    monkeypatch.setattr(internals.time, "monotonic", lambda: now)
    executor = Executor()
    watch_jobs(executor, 15)

    def interval_after(seconds: float, *jobs: str) -> float:
        nonlocal now
        now += seconds

        async def check() -> None:
            [job async for job in executor.check_active_jobs(jobs)]

        asyncio.run(check())
        return executor.next_seconds_between_status_checks

    assert interval_after(5, "running") == 5
    assert interval_after(5, "running") == 5
    assert interval_after(75, "running") == 8
    assert interval_after(1000, "running") == 15
    assert interval_after(15, "running", "finished") == 5, "a job has ended"
    assert interval_after(1000, "running") == 15
    assert interval_after(15, "running", "unknown") == 5, "a job was submitted"


# --- the terminal ---------------------------------------------------------------------------------

PLAN = "x" * 100_000
COMMAND = f"set -euo pipefail;  python -m stages.workflow.plan --plan '{PLAN}'"


class Told:
    """The calls of a run's listener."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []

    def __getattr__(self, name: str) -> object:
        return lambda *args: self.calls.append((name, *args))


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    """What a listener is told, with the handler that Snakemake makes and its settings."""
    handler = ColorizingTextHandler(nocolor=True, stream=io.StringIO())
    handler.name = "DefaultStreamHandler"
    monkeypatch.setattr(logger, "handlers", [handler])
    monkeypatch.setattr(logger, "level", logging.INFO)
    monkeypatch.setattr(logging, "raiseExceptions", True)
    listener = Told()
    internals.listen(SimpleNamespace(output_settings=OutputSettings()), listener)
    assert [type(found) for found in logger.handlers] == [internals.RunHandler]
    return listener


def rule_exception(end: str) -> None:
    text = 'RuleException:\nCalledProcessError in file "/p/Snakefile", line 94:\n'
    text += f"Command '{COMMAND}' {end}\n"
    logger.error(text, extra={"event": LogEvent.ERROR, "exception": "RuleException"})


def job_error() -> None:
    extra = {"rule_name": "plan", "log": ["results/garden/logs/plan.log"], "shellcmd": COMMAND}
    logger.error("Error in rule plan, jobid: 1", extra={"event": LogEvent.JOB_ERROR, **extra})


@pytest.mark.parametrize(
    ("end", "said"),
    [
        ("returned non-zero exit status 2.", "its command returned non-zero exit status 2"),
        ("returned non-zero exit status 130.", internals.INTERRUPTED),
        ("died with <Signals.SIGINT: 2>.", internals.INTERRUPTED),
        ("returned non-zero exit status 137.", "it was killed"),
        ("died with <Signals.SIGKILL: 9>.", "it was killed"),
        ("died with <Signals.SIGTERM: 15>.", "died with <Signals.SIGTERM: 15>"),
    ],
)
def test_a_failed_job_is_told_with_its_log_and_the_end_of_its_command(
    told: Told, end: str, said: str
) -> None:
    rule_exception(end)
    job_error()
    ((name, log, how),) = told.calls
    assert (name, log) == ("job_failed", Path("results/garden/logs/plan.log"))
    assert said in how and len(how) < 200


def test_a_failed_job_without_a_log_is_told(told: Told) -> None:
    """The tables of a batch: their job may be killed."""
    rule_exception("died with <Signals.SIGKILL: 9>.")
    extra = {"rule_name": "benchmark", "log": [], "shellcmd": COMMAND}
    logger.error("Error in rule benchmark", extra={"event": LogEvent.JOB_ERROR, **extra})
    ((name, text),) = told.calls
    assert name == "message" and text.startswith("error in benchmark: its command died")


def test_errors_and_warnings_of_snakemake_are_told_and_its_routine_is_not(told: Told) -> None:
    for text in ("Building DAG of jobs...", "Select jobs to execute..."):
        logger.info(text)
    logger.info("3 jobs", extra={"event": LogEvent.RUN_INFO})
    logger.info("Select jobs to execute...")
    logger.info("rule plan:", extra={"event": LogEvent.JOB_INFO})
    logger.info("Finished jobid: 1", extra={"event": LogEvent.JOB_FINISHED})
    logger.info("Nothing to be done (all requested files are present and up to date).")
    logger.info("Terminating processes on user request, this might take some time.")
    logger.error("Exiting because a job execution failed. Look below for error messages")
    logger.error("WorkflowError:\nMissing input", extra={"event": LogEvent.ERROR})
    logger.error(
        "WorkflowError:\nError recording metadata ([Errno 28] No space left on device). Please "
        "ensure write permissions",
        extra={"event": LogEvent.ERROR, "exception": "WorkflowError"},
    )
    assert told.calls == [
        ("message", "Select jobs to execute..."),
        ("poll",),
        ("nothing_to_do", False),
        ("cancelled",),
        ("message", "WorkflowError:\nMissing input"),
        ("message", "Snakemake cannot write its own files: the disk is full"),
    ]


def test_a_log_on_a_full_disk_prints_no_traceback(
    told: Told, capsys: pytest.CaptureFixture[str]
) -> None:
    log = logging.FileHandler("/dev/full")
    logger.addHandler(log)
    logger.error("Error in rule plan")
    assert told.calls and capsys.readouterr().err == ""
