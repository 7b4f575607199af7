"""A running stage's lock and log."""

from __future__ import annotations

import fcntl
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.runtime.progress import Console


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
