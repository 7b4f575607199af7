"""The locks of a run and of a running stage, and a stage's log."""

from __future__ import annotations

import contextlib
import errno
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
from pipeline.runtime.layout import STAGE_OUTPUT
from pipeline.runtime.progress import Console

_held: dict[Path, TextIO] = {}
# Errors of file systems without locks, such as some mounts of NFS and Lustre.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL)


def lock_run(folder: Path) -> None:
    """Lock a run's folder of results until this process ends.

    Snakemake's own lock is in its working directory; several can have the same results. On a file
    system without locks, only a warning is printed.

    Raises:
        UserError: Another process has locked it.
        PermissionError: This user may not write the lock's file, and no process has locked it.
    """
    path = _lock_file(folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        file = open(path, "a+", encoding="utf-8")  # noqa: SIM115  (open until the process ends)
    except PermissionError:
        check_not_locked(folder)
        raise
    try:
        has_locks = _lock(file, fcntl.LOCK_EX, folder)
    except UserError:
        file.close()
        raise
    if not has_locks:
        print(
            f"warning: {folder}: its file system has no locks: do not run the same scene twice at "
            "the same time",
            file=sys.stderr,
        )
    file.truncate(0)
    file.write(f"{user_name()} on {platform.node()}, process {os.getpid()}\n")
    file.flush()
    _held[path.absolute()] = file


def check_not_locked(folder: Path) -> None:
    """Check that no other process has locked a run's folder of results, which this user need not be
    allowed to write.

    Raises:
        UserError: Another process has locked it.
    """
    path = _lock_file(folder)
    if path.absolute() in _held:
        return
    try:
        file = open(path, encoding="utf-8")  # noqa: SIM115  (closed below)
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return
    with file:
        # Over NFS, an exclusive lock needs the permission to write.
        _lock(file, fcntl.LOCK_SH, folder)


def user_name() -> str:
    """The name of this process's user; its number if it has no name, as in some containers."""
    with contextlib.suppress(OSError, KeyError):
        return getpass.getuser()
    return str(os.getuid())


def _lock_file(folder: Path) -> Path:
    return folder / ".scratch" / "run.lock"


def _lock(file: TextIO, kind: int, folder: Path) -> bool:
    """Lock a run's file. Return False if its file system has no locks.

    Raises:
        UserError: Another process has locked it.
    """
    try:
        return _flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        owner = file.read().strip() or "starting"
        what = f"another run is writing these results ({owner})"
        fix = "wait until it has ended or end it, then run the same command again"
        raise UserError(what, file=folder, fix=fix) from None


def _flock(file: TextIO, kind: int) -> bool:
    """Lock a file. Return False if its file system has no locks.

    Raises:
        BlockingIOError: Another process has locked it.
    """
    try:
        fcntl.flock(file, kind)
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        return False
    return True


@contextmanager
def locked(path: Path, stage: str, out: Path) -> Iterator[None]:
    """Hold a stage's lock. A job that was orphaned by a killed Snakemake may still be writing to
    the stage's folder ``out``."""
    with open(path, "w") as file:
        try:
            _flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(
                f"{stage}: waiting for another run that writes to {out}",
                file=sys.stderr,
                flush=True,
            )
            _flock(file, fcntl.LOCK_EX)
        yield


@contextmanager
def logging_to(path: Path | None, name: str) -> Iterator[None]:
    """Copy stderr to the file ``path``; progress lines on the terminal begin with ``name``.

    If the environment variable ``STAGE_OUTPUT`` is "log", stderr is replaced by the file, also for
    compiled libraries and child processes.
    """
    if path is None:
        yield
        return
    terminal: TextIO = sys.stderr
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        log = open(path, "w", encoding="utf-8", errors="backslashreplace")  # noqa: SIM115  (closed below)
    except OSError:
        # The stage will fail for the same reason, with a complete message.
        yield
        return
    only_log = os.environ.get(STAGE_OUTPUT) == "log"
    terminal.flush()
    with open(os.dup(2), "w", encoding="utf-8", errors="backslashreplace") as original:
        if only_log:
            os.dup2(log.fileno(), 2)
            terminal = original
        console = Console(terminal, log, f"{name}: ", only_log=only_log)
        before, sys.stderr = sys.stderr, console  # type: ignore[assignment]
        try:
            yield
        finally:
            console.clear()
            console.flush()
            sys.stderr = before
            os.dup2(original.fileno(), 2)
        # Closing writes what a full disk has refused before.
        with contextlib.suppress(OSError):
            log.close()
