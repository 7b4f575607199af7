"""Everything of Snakemake that this program reads or changes and that Snakemake does not document.

``tests/stages/test_internals.py`` and ``tests/cluster/test_executor.py`` have a contract test of
each part. The page ``docs/explanation/snakemake.md`` says what each part is for.
"""

from __future__ import annotations

import errno
import logging
import re
import time
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any

from snakemake.logging import DefaultFormatter, get_event, logger
from snakemake.persistence import PersistenceBase
from snakemake_interface_logger_plugins.common import LogEvent

from pipeline.runtime.errors import EXIT_USER_ERROR

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
_SIGKILL = 9
_DISK_FULL = f"[Errno {errno.ENOSPC}]"


def shorten_failures() -> None:
    """Leave the commands of failed jobs, and tracebacks about Snakemake's log file on a full disk,
    out of what Snakemake prints on the terminal.

    A job's command contains the stage's key or the whole plan, and Snakemake prints it twice after
    the job's own message. Snakemake's log file still has both.
    """
    logging.raiseExceptions = False
    for handler in logger.handlers:
        if handler.name == _TERMINAL and type(handler.formatter) is DefaultFormatter:
            usual = handler.formatter
            handler.setFormatter(_ShortFormatter(usual.quiet, usual.show_failed_logs))
            handler.addFilter(_has_news)


class _ShortFormatter(DefaultFormatter):
    """Snakemake's format without the commands of failed jobs."""

    def format(self, record: logging.LogRecord) -> str:
        if record.levelno >= logging.WARNING and _DISK_FULL in str(record.msg):
            return "Snakemake cannot write its own files: the disk is full"
        return _command_end(record) or super().format(record)

    def format_job_error(self, msg: dict[str, Any]) -> str:
        # Snakemake prints "message: None" for rules without a message.
        return super().format_job_error(msg | {"shellcmd": None, "msg": msg["rule_msg"]})


def _has_news(record: logging.LogRecord) -> bool:
    """Return False if Snakemake repeats that a job has ended with a message of its own."""
    return not (_command_end(record) or "").endswith(f" {EXIT_USER_ERROR}")


def _command_end(record: logging.LogRecord) -> str | None:
    """A sentence about the end of a command that failed; None for a record of something else."""
    text = str(record.msg)
    if get_event(record) is not LogEvent.ERROR or _COMMAND_FAILED not in text:
        return None
    ends = _END.findall(text)
    if not ends:
        return None
    what, status, signal = ends[-1]
    killed = _SIGKILL in (int(signal or 0), int(status or 0) - 128)
    return f"A job's command {what}" + (": it was killed, as for want of memory" if killed else "")
