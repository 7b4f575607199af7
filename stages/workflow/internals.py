"""Everything of Snakemake that this program reads or changes and that Snakemake does not document.

``tests/stages/test_internals.py`` and ``tests/cluster/test_executor.py`` have a contract test of
each part. The page ``docs/explanation/snakemake.md`` says what each part is for.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import time
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from snakemake.logging import get_event, logger
from snakemake.persistence import PersistenceBase
from snakemake_interface_logger_plugins.base import LogHandlerBase
from snakemake_interface_logger_plugins.common import LogEvent

from pipeline.runtime.layout import as_called

# --- the run ------------------------------------------------------------------------------------


class Flow:
    """Reads and changes undocumented parts of Snakemake's ``workflow``.

    Attributes:
        folder: The folder of the Snakefile.
    """

    def __init__(self, workflow: Any):
        self._workflow = workflow
        self.folder: str = workflow.basedir

    @property
    def in_job(self) -> bool:
        """Whether this Snakemake is itself in a job of a cluster."""
        return bool(self._workflow.remote_exec)

    @property
    def submits_jobs(self) -> bool:
        """Whether jobs are submitted to a cluster."""
        return bool(self._workflow.non_local_exec)

    @property
    def runs_jobs(self) -> bool:
        """Whether this Snakemake runs jobs and is not itself in one."""
        flow = self._workflow
        return bool(flow.is_main_process and flow.executor_plugin and not flow.dryrun)

    @property
    def is_shown(self) -> bool:
        """Whether this Snakemake shows a run to a user, and is not in a job of another."""
        return bool(self._workflow.is_main_process)

    @property
    def shows_logs(self) -> bool:
        """The value of ``--show-failed-logs``."""
        return bool(self._workflow.output_settings.show_failed_logs)

    @property
    def is_verbose(self) -> bool:
        """The value of ``--verbose``."""
        return bool(self._workflow.output_settings.verbose)

    @property
    def is_dry_run(self) -> bool:
        """Whether ``--dry-run`` is given."""
        return bool(self._workflow.output_settings.dryrun)

    @property
    def is_quiet(self) -> bool:
        """Whether ``--quiet all`` is given."""
        return "ALL" in {about.name for about in self._workflow.output_settings.quiet or ()}

    @property
    def cores(self) -> int:
        """The number of cores of this machine that jobs may use; not with a cluster."""
        return int(self._workflow.cores)

    @property
    def cores_option(self) -> int | None:
        """The value of ``--cores``."""
        cores = self._workflow.resource_settings.cores
        return None if cores is None else int(cores)

    @property
    def decides_jobs(self) -> bool:
        """Whether this Snakemake decides which jobs run."""
        return self._workflow.dag is not None and not self.in_job

    @property
    def compares_keys(self) -> bool:
        """Whether a job runs again if its params have changed (``--rerun-triggers``)."""
        return "PARAMS" in {trigger.name for trigger in self._workflow.rerun_triggers}

    def force(self, file: Path) -> None:
        """Run the job that makes this file, as with ``--forcerun``."""
        self._workflow.dag.forcefiles.add(str(file))

    def needed_jobs(self) -> list[Any]:
        """The jobs that will run."""
        return list(self._workflow.dag.needrun_jobs())

    def targets(self) -> list[str]:
        """The files that were asked for."""
        files = [job.output or job.input for job in self._workflow.dag.targetjobs]
        return sorted(str(file) for outputs in files for file in outputs)

    def cause(self, job: Any) -> str:
        """Why a job that has a result runs again; empty if it has none, or only because others run
        before it."""
        reason = self._workflow.dag.reason(job)
        causes = {
            "forced": "its result is not current",
            "params_changed": "options changed",
            "code_changed": "the program changed",
            "updated_input": "an input is newer",
        }
        found = [text for name, text in causes.items() if getattr(reason, name)]
        return found[0] if found and not reason.missing_output else ""

    def unlimit_rate(self) -> None:
        """Start jobs at any rate: Snakemake's limiter uses a considerable share of a core after
        some dozens of jobs."""
        self._workflow.scheduler.job_rate_limiter = None

    def watch(self, jobs: Sequence[Any]) -> None:
        """Apply ``watch_jobs`` to the executors of these jobs."""
        interval = self._workflow.remote_execution_settings.seconds_between_status_checks
        scheduler = self._workflow.scheduler
        for executor in {scheduler.get_executor(job) for job in jobs if not job.is_local}:
            watch_jobs(executor, interval)


# --- executors of clusters ----------------------------------------------------------------------

# Snakemake's executor names the jobs of a run by a UUID, after the prefix of the profile, if any.
JOB_NAME = re.compile(r"(?:.+_)?[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")
# Seconds between two checks of jobs: a tenth of the time since a job last started or ended, so that
# the wait for a check is short beside the job, but at least five.
SHORTEST_INTERVAL, INTERVAL_SHARE = 5.0, 0.1


def watch_jobs(executor: Any, seconds: float) -> None:
    """Let an executor of Snakemake check its jobs at this interval at most, more often after one
    has started or ended, and each job until it has reported its end.

    Slurm's executor increases its interval up to three minutes. It forgets its jobs when Slurm does
    not answer, as while the controller is started again: Snakemake would never end.
    """
    check, finished = executor.check_active_jobs, set()
    known: set[int] = set()
    changed = time.monotonic()

    def recording(report: Callable[..., None]) -> Callable[..., None]:
        def reported(job: Any, *args: Any, **options: Any) -> None:
            finished.add(id(job))
            report(job, *args, **options)

        return reported

    async def checked(active: Sequence[Any]) -> AsyncIterator[Any]:
        nonlocal changed
        finished.clear()
        yielded = set()
        async for job in check(active):
            yielded.add(id(job))
            yield job
        for job in active:
            if id(job) not in yielded | finished:
                yield job
        jobs, now = {id(job) for job in active}, time.monotonic()
        if finished or not jobs <= known:
            changed = now
        known.clear()
        known.update(jobs)
        young = max(SHORTEST_INTERVAL, INTERVAL_SHARE * (now - changed))
        due = min(seconds, young, executor.next_seconds_between_status_checks)
        executor.next_seconds_between_status_checks = due

    executor.report_job_success = recording(executor.report_job_success)
    executor.report_job_error = recording(executor.report_job_error)
    executor.check_active_jobs = checked


# --- the folder .snakemake ----------------------------------------------------------------------


def use_locks_of_runs() -> None:
    """Make Snakemake run as with ``--nolock``, whatever its profile is.

    Snakemake's lock is a set of files in ``.snakemake/locks``. A killed Snakemake leaves them
    behind, and one that ends removes those of all others. The lock of a run
    (``pipeline.runtime.lock``) concerns one folder of results, and the kernel releases it when its
    process ends. ``--unlock`` still removes such files.
    """
    PersistenceBase.lock = PersistenceBase.noop
    # A dry run only prints that it found lock files.
    PersistenceBase.lock_warn_only = PersistenceBase.noop


def prepare_folder(own: Path) -> None:
    """Create ``.snakemake/incomplete`` if Snakemake has not used this folder yet.

    Snakemake takes a folder with ``metadata`` and without ``incomplete`` for one of an old version
    and migrates it, which fails if several start at once.
    """
    if not (own / "metadata").exists():
        (own / "incomplete").mkdir(parents=True, exist_ok=True)


# --- the terminal -------------------------------------------------------------------------------

_TERMINAL = "DefaultStreamHandler"
_COMMAND_FAILED = "CalledProcessError in file "
# Python's sentences about a command that failed. They follow the command.
_END = re.compile(r"(returned non-zero exit status (\d+)|died with <Signals\.\w+: (\d+)>)\.$", re.M)
_SIGKILL, _SIGINT = 9, 2
_DISK_FULL = f"[Errno {errno.ENOSPC}]"
_NOTHING_TO_DO = "Nothing to be done"
_SUBMITTED = re.compile(r"Job \S+ has been submitted with SLURM jobid (\d+)")
_CANCELLED = "Terminating processes on user request"
# Messages before the first job that have no event.
_ROUTINE = (
    *("Building DAG of jobs", "Assuming unrestricted shared", "Using shell:", "Group jobs:"),
    *("Config file ", "SLURM run ID"),
)
# Warnings that say nothing new: those after a failed job, and those of Slurm's executor where the
# profile names no account.
_KNOWN = (
    "Exiting because a job execution failed",
    "WorkflowError:\nAt least one job did not complete successfully",
    *("No SLURM account given", "No account was given", "Unable to guess SLURM account"),
)

INTERRUPTED = "it was interrupted"


class Listener(Protocol):
    """Receives the events of a run."""

    def dry_run(self) -> None:
        """The jobs that a dry run would run are known."""

    def nothing_to_do(self, dry_run: bool) -> None:
        """No job has to run."""

    def poll(self) -> None:
        """A job has ended."""

    def job_failed(self, log: Path, end: str) -> None:
        """A job with this log has failed. ``end`` says how its command ended; it may be empty."""

    def cancelled(self) -> None:
        """Ctrl-C was pressed."""

    def message(self, text: str) -> None:
        """Snakemake has a message for the user."""


class RunHandler(LogHandlerBase):
    """A logger plugin's handler, which passes on what a user must be told of a run.

    Snakemake's other messages are in its log file.
    """

    writes_to_stream = True
    writes_to_file = False
    has_filter = True
    has_formatter = True
    needs_rulegraph = False

    def __init__(self, settings: Any, listener: Listener):
        super().__init__(settings, None)
        self._listener = listener
        self._end = ""
        self._knows_jobs = False

    def emit(self, record: logging.LogRecord) -> None:
        event, text = get_event(record), str(record.msg)
        dry_run = bool(self.common_settings.dryrun)
        if event is LogEvent.RUN_INFO:
            if dry_run and not self._knows_jobs:
                self._listener.dry_run()
            self._knows_jobs = True
        elif event is LogEvent.JOB_FINISHED:
            self._listener.poll()
        elif event is LogEvent.JOB_ERROR:
            logs = record.__dict__["log"]
            for log in logs:
                self._listener.job_failed(Path(log), self._end)
            if not logs:
                rule = record.__dict__["rule_name"]
                self._listener.message(f"error in {rule}: {self._end or 'it failed'}")
        elif (end := _command_end(record)) is not None:
            self._end = end
        elif text.startswith(_NOTHING_TO_DO):
            self._listener.nothing_to_do(dry_run)
        elif record.levelno >= logging.WARNING:
            if not text.startswith(_KNOWN) and event is not LogEvent.GROUP_ERROR:
                full = _DISK_FULL in text
                short = "Snakemake cannot write its own files: the disk is full"
                self._listener.message(short if full else text)
        elif submitted := _SUBMITTED.match(text):
            self._listener.message(f"  submitted  Slurm job {submitted[1]}")
        elif text.startswith(_CANCELLED):
            self._listener.cancelled()
        elif event is None and not self._knows_jobs and not text.startswith(_ROUTINE):
            self._listener.message(text)


def listen(workflow: Any, listener: Listener) -> None:
    """Pass on to ``listener`` what a user must be told. Snakemake prints only with ``--verbose``.

    Tracebacks about Snakemake's log file on a full disk are left out.
    """
    logging.raiseExceptions = False
    settings = workflow.output_settings
    for handler in [found for found in logger.handlers if found.name == _TERMINAL]:
        if not settings.verbose:
            logger.removeHandler(handler)
        logger.addHandler(RunHandler(settings, listener))


def log_file() -> str:
    """The file with Snakemake's own messages; empty without one."""
    files = (getattr(handler, "baseFilename", "") for handler in logger.handlers)
    return next((str(as_called(Path(os.path.relpath(file)))) for file in files if file), "")


def _command_end(record: logging.LogRecord) -> str | None:
    """How a command that failed has ended; None for a record of something else."""
    text = str(record.msg)
    if get_event(record) is not LogEvent.ERROR or _COMMAND_FAILED not in text:
        return None
    ends = _END.findall(text)
    if not ends:
        return None
    what, status, signal = ends[-1]
    number = int(signal or 0) or int(status or 0) - 128
    if number == _SIGINT:
        return INTERRUPTED
    killed = number == _SIGKILL
    return f"its command {what}" + (": it was killed, as for want of memory" if killed else "")
