"""Snakemake's terminal output about a failed job holds no command line."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator

import pytest
from snakemake.logging import ColorizingTextHandler, DefaultFilter, DefaultFormatter, logger
from snakemake_interface_logger_plugins.common import LogEvent

from stages.workflow.terminal import shorten_failures

PLAN = "x" * 100_000
COMMAND = f"set -euo pipefail;  python -m stages.workflow.plan --plan '{PLAN}'"


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[io.StringIO]:
    """What Snakemake's logger prints, with the handler that Snakemake makes."""
    output = io.StringIO()
    handler = ColorizingTextHandler(nocolor=True, stream=output)
    handler.name = "DefaultStreamHandler"
    handler.addFilter(DefaultFilter((), False, False, False, False))
    handler.setFormatter(DefaultFormatter(None, False))
    monkeypatch.setattr(logger, "handlers", [handler])
    monkeypatch.setattr(logging, "raiseExceptions", True)
    shorten_failures()
    yield output


def rule_exception(end: str) -> None:
    text = 'RuleException:\nCalledProcessError in file "/p/Snakefile", line 94:\n'
    text += f"Command '{COMMAND}' {end}\n"
    logger.error(text, extra={"event": LogEvent.ERROR, "exception": "RuleException"})


@pytest.mark.parametrize(
    ("end", "said"),
    [
        ("returned non-zero exit status 2.", ""),
        ("returned non-zero exit status 1.", "returned non-zero exit status 1"),
        ("returned non-zero exit status 137.", "it was killed"),
        ("died with <Signals.SIGKILL: 9>.", "it was killed"),
        ("died with <Signals.SIGTERM: 15>.", "died with <Signals.SIGTERM: 15>"),
    ],
)
def test_the_end_of_a_command_is_said_unless_the_job_has_a_message(
    terminal: io.StringIO, end: str, said: str
) -> None:
    rule_exception(end)
    assert said in terminal.getvalue() and len(terminal.getvalue()) < 200
    assert bool(terminal.getvalue().strip()) == bool(said)


def test_an_error_in_a_rule_names_its_log_and_no_command(terminal: io.StringIO) -> None:
    names = ("jobid", "input", "output", "conda_env")
    logger.error(
        "Error in rule plan, jobid: 1",
        extra={
            "event": LogEvent.JOB_ERROR,
            "rule_name": "plan",
            "rule_msg": None,
            "log": ["results/garden/logs/plan.log"],
            "shellcmd": COMMAND,
            "aux": {},
            **dict.fromkeys(names),
        },
    )
    said = terminal.getvalue()
    assert "Error in rule plan" in said and "logs/plan.log" in said
    assert "python -m" not in said and "None:" not in said


def test_a_full_disk_under_snakemakes_own_files_is_named(terminal: io.StringIO) -> None:
    logger.error(
        "WorkflowError:\nError recording metadata for finished job ([Errno 28] No space left on "
        "device). Please ensure write permissions",
        extra={"event": LogEvent.ERROR, "exception": "WorkflowError"},
    )
    assert "the disk is full" in terminal.getvalue()
    assert "permissions" not in terminal.getvalue()


def test_other_messages_stay_as_they_are(terminal: io.StringIO) -> None:
    logger.error("WorkflowError:\nMissing input", extra={"event": LogEvent.ERROR})
    logger.warning("Building DAG of jobs...")
    assert terminal.getvalue() == "WorkflowError:\nMissing input\nBuilding DAG of jobs...\n"


def test_a_log_on_a_full_disk_prints_no_traceback(
    terminal: io.StringIO, capsys: pytest.CaptureFixture[str]
) -> None:
    log = logging.FileHandler("/dev/full")
    logger.addHandler(log)
    logger.error("Error in rule plan")
    assert terminal.getvalue() and capsys.readouterr().err == ""
