"""Snakemake's messages about failed jobs, shortened for the terminal.

A job's command contains the stage's key or the whole plan, and Snakemake prints it twice after the
job's own message. The terminal shows neither; Snakemake's log file has both.
"""

from __future__ import annotations

import errno
import logging
import re
from typing import Any

from snakemake.logging import DefaultFormatter, get_event, logger
from snakemake_interface_logger_plugins.common import LogEvent

from pipeline.runtime.errors import EXIT_USER_ERROR

_TERMINAL = "DefaultStreamHandler"
_COMMAND_FAILED = "CalledProcessError in file "
# Python's sentences about a command that failed. They follow the command.
_END = re.compile(r"(returned non-zero exit status (\d+)|died with <Signals\.\w+: (\d+)>)\.$", re.M)
_SIGKILL = 9
_DISK_FULL = f"[Errno {errno.ENOSPC}]"


def shorten_failures() -> None:
    """Leave the commands of failed jobs, and tracebacks about Snakemake's log file on a full disk,
    out of what Snakemake prints on the terminal."""
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
