"""The locks of a run and of a running stage, and a stage's log."""

from __future__ import annotations

import contextlib
import fcntl
import getpass
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import Console

_held: list[TextIO] = []


def lock_run(folder: Path) -> None:
    """Lock a run's folder of results until this process ends.

    Snakemake's own lock is in its working directory; several can have the same results.

    Raises:
        UserError: another process has locked it.
    """
    path = folder / ".scratch" / "run.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    file = open(path, "a+", encoding="utf-8")  # noqa: SIM115  (open until the process ends)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        owner = file.read().strip() or "starting"
        file.close()
        what = f"another run is writing these results ({owner})"
        fix = "wait until it has ended or end it, then run the same command again"
        raise UserError(what, file=folder, fix=fix) from None
    file.truncate(0)
    file.write(f"{_user()} on {platform.node()}, process {os.getpid()}\n")
    file.flush()
    _held.append(file)


def _user() -> str:
    with contextlib.suppress(OSError, KeyError):
        return getpass.getuser()
    return str(os.getuid())


@contextmanager
def locked(path: Path, stage: str, out: Path) -> Iterator[None]:
    """Hold a stage's lock. A job that was orphaned by a killed Snakemake may still be writing to
    the stage's folder ``out``."""
    with open(path, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            print(
                f"{stage}: waiting for another run that writes to {out}",
                file=sys.stderr,
                flush=True,
            )
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextmanager
def logging_to(path: Path | None, name: str) -> Iterator[None]:
    """Copy stderr to the file ``path``; progress lines on the terminal begin with ``name``."""
    if path is None:
        yield
        return
    terminal = sys.stderr
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        log = open(path, "w", encoding="utf-8", errors="backslashreplace")  # noqa: SIM115  (closed below)
    except OSError:
        # The stage will fail for the same reason, with a complete message.
        yield
        return
    with log:
        console = Console(terminal, log, f"{name}: ")
        sys.stderr = console  # type: ignore[assignment]
        try:
            yield
        finally:
            console.clear()
            console.flush()
            sys.stderr = terminal
