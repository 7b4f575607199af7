"""What is held while a stage runs: its lock and its log."""

from __future__ import annotations

import fcntl
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.runtime.progress import Console


@contextmanager
def locked(path: Path, stage: str, out: Path) -> Iterator[None]:
    """Hold a stage's lock: a job orphaned by a killed Snakemake may still be writing to its
    folder ``out``."""
    with open(path, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            print(
                f"{stage}: another run is at work on {out}; waiting for it",
                file=sys.stderr,
                flush=True,
            )
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextmanager
def logging_to(path: Path | None, name: str) -> Iterator[None]:
    """Write what goes to stderr into the file ``path`` too, with ``name`` before each line on the
    terminal."""
    if path is None:
        yield
        return
    terminal = sys.stderr
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        log = open(path, "w")  # noqa: SIM115  (closed below)
    except OSError:
        # The work itself fails for the same reason, with the full message.
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
