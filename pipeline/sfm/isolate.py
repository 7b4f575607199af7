"""Run a function in a process of its own.

pycolmap crashes beside torch, and where it was imported before cv2 (both bring a libpng and a
zlib of their own), so libraries that must not meet are kept apart here.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, TypeVar

from pipeline.runtime import progress
from pipeline.runtime.errors import UserError

T = TypeVar("T")


def run_isolated(function: Callable[..., T], /, *args: Any, **kwargs: Any) -> T:
    """Call ``function(*args, **kwargs)`` in a fresh (spawned) process and return its value.

    The function, its arguments and its value must pickle; the function's module is imported in
    the new process, nothing else of this one is. Progress goes to the same file. The process
    ends when this one does, even by SIGKILL.

    Raises:
        UserError: the one the function raised.
        RuntimeError: any other exception (with its traceback as text), or the process died.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    # The pipe's other end: closed by the system when this process goes, whatever the way.
    leash_child, leash_parent = context.Pipe(duplex=False)
    process = context.Process(
        target=_child, args=(theirs, leash_child, progress._file, function, args, kwargs)
    )
    process.start()
    theirs.close()
    leash_child.close()
    try:
        status, value = ours.recv()
    except EOFError:
        process.join()
        raise RuntimeError(f"{function.__qualname__} {_death(process.exitcode)}") from None
    finally:
        if sys.exc_info()[0] is KeyboardInterrupt:
            process.terminate()
        process.join()
        leash_parent.close()
        ours.close()
    if status == "user error":
        raise UserError(value["what"], file=value["file"], fix=value["fix"])
    if status == "error":
        raise RuntimeError(f"{function.__qualname__} failed:\n{value}")
    result: T = value
    return result


def _child(
    results: Connection,
    leash: Connection,
    progress_file: Path | None,
    function: Callable[..., Any],
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
) -> None:
    threading.Thread(target=_die_with_parent, args=(leash,), daemon=True).start()
    progress.write_progress_to(progress_file)
    if progress_file is not None:
        sys.stderr = progress.Console(sys.stderr, None)  # type: ignore[assignment]
    try:
        results.send(("value", function(*args, **kwargs)))
    except UserError as error:
        results.send(("user error", {"what": error.what, "file": error.file, "fix": error.fix}))
    except Exception:
        results.send(("error", traceback.format_exc()))
    if isinstance(sys.stderr, progress.Console):
        sys.stderr.clear()
    # Destructors of extension libraries have nothing left to do that is worth a crash here.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _die_with_parent(leash: Connection) -> None:
    wait([leash])
    os._exit(1)


def _death(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"died by signal {signal.Signals(-exit_code).name} (out of memory, perhaps)"
    return f"ended without a result (exit code {exit_code})"
