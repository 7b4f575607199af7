"""How the runs of a batch and their jobs ended, according to their logs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pipeline.config.runs import Run
from pipeline.plan.record import read_plan
from pipeline.runtime.errors import UserError


def outcome(
    run: Run, message: str | None, status: str = "left out", stage: str = ""
) -> dict[str, Any]:
    """The record of a run for ``stages.workflow.batch.write_batch``.

    Args:
        message: The reason why the run has no result; None if it has one.
    """
    named = {"run": [run.scene, run.config, run.seed]}
    if message is None:
        return named | {"status": "ok"}
    return named | {"status": status, "stage": stage, "message": message.strip()}


def failed_job(run: Run, stage: str, log: Path, started: float) -> dict[str, Any]:
    """The record of a run whose first job without a result is one of ``stage``.

    Args:
        log: The log of the job.
        started: The time at which Snakemake was started.
    """
    if not _was_written(log, started):
        return outcome(run, "another failure stopped the batch", "not run", stage)
    unknown = f"it ended without a message (it may have been killed): see {log}"
    return outcome(run, error_in(log, started) or unknown, "failed", stage)


def error_in(log: Path, started: float) -> str:
    """The message of a job that has ended with a UserError since ``started``; else empty."""
    if not _was_written(log, started):
        return ""
    _, found, message = f"\n{log.read_text()}".rpartition("\nerror in ")
    return message.partition(": ")[2].rstrip() if found else ""


def was_made(folder: Path, stage: str) -> bool:
    """Whether the last plan of a run has the stage with this folder, and the run has finished."""
    try:
        runs = read_plan(folder.parent).runs(stage)
    except UserError:
        return False
    return runs and (folder.parent / "metrics.json").is_file()


def interrupted_at(log: Path, started: float) -> str | None:
    """Where Ctrl-C has stopped a job since ``started``, such as " at step 702 of 1500" or empty;
    None for a job that was not stopped."""
    found = re.search(r"^\w+: stopped(| at .+)$", "\n".join(last_lines(log, started)), re.M)
    return found and found[1]


def last_lines(log: Path, started: float, number: int = 3) -> list[str]:
    """The last lines of a log that was written since ``started``."""
    if not _was_written(log, started):
        return []
    return [line for line in log.read_text().splitlines() if line.strip()][-number:]


def _was_written(log: Path, started: float) -> bool:
    return log.is_file() and log.stat().st_mtime >= started
