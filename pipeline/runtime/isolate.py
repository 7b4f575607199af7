"""Run a function in a separate process.

pycolmap crashes in a process that has loaded torch, or that imports cv2 after pycolmap (both bundle
libpng and zlib). Functions that use incompatible libraries run in separate processes, and so do
native readers that crash on damaged files.
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


class ProcessDied(RuntimeError):
    """The process of a function ended without a result: a crash of native code."""


def run_isolated(function: Callable[..., T], /, *args: Any, **kwargs: Any) -> T:
    """Call ``function(*args, **kwargs)`` in a new (spawned) process and return its value.

    The function, its arguments and its value must be picklable; the new process imports the
    function's module only. Progress is written to the same file. The process ends when the calling
    process ends, even by SIGKILL.

    Raises:
        UserError: raised by the function.
        RuntimeError: the function raised another exception; the message has its traceback.
        ProcessDied: the process died.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    # The operating system closes the parent's end of this pipe when the parent ends.
    parent_alive, held_by_parent = context.Pipe(duplex=False)
    process = context.Process(
        target=_child, args=(sender, parent_alive, progress._file, function, args, kwargs)
    )
    process.start()
    sender.close()
    parent_alive.close()
    try:
        status, value = receiver.recv()
    except EOFError:
        process.join()
        raise ProcessDied(f"{function.__qualname__} {_death(process.exitcode)}") from None
    finally:
        if sys.exc_info()[0] is KeyboardInterrupt:
            process.terminate()
        process.join()
        held_by_parent.close()
        receiver.close()
    if status == "user error":
        raise UserError(value["what"], file=value["file"], fix=value["fix"])
    if status == "error":
        raise RuntimeError(f"{function.__qualname__} failed:\n{value}")
    result: T = value
    return result


def _child(
    results: Connection,
    parent_alive: Connection,
    progress_file: Path | None,
    function: Callable[..., Any],
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
) -> None:
    threading.Thread(target=_exit_with_parent, args=(parent_alive,), daemon=True).start()
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
    # Skip the destructors of extension libraries: they may crash.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _exit_with_parent(parent_alive: Connection) -> None:
    wait([parent_alive])
    os._exit(1)


def _death(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"died by signal {signal.Signals(-exit_code).name} (out of memory, perhaps)"
    return f"ended without a result (exit code {exit_code})"
