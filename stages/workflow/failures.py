"""Errors of the workflow's own jobs, which are not stages."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from pipeline.runtime.errors import EXIT_USER_ERROR, UserError, as_user_error


@contextmanager
def reporting_errors(job: str) -> Iterator[None]:
    """End the process with one message and exit code 2 if the user can correct the error.

    Args:
        job: The name of the job in the message.
    """
    try:
        yield
    except (UserError, OSError) as error:
        known = error if isinstance(error, UserError) else as_user_error(error)
        if known is None:
            raise
        print(f"error in {job}: {known}", file=sys.stderr, flush=True)
        sys.exit(EXIT_USER_ERROR)


def exit_with(error: UserError) -> NoReturn:
    """End Snakemake with the error's warnings and message, without a traceback."""
    for warning in error.warnings:
        print(f"  warning: {warning}", file=sys.stderr)
    print(f"error: {error}", file=sys.stderr, flush=True)
    raise SystemExit(EXIT_USER_ERROR) from None
