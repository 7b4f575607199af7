"""Run a function in a separate process.

pycolmap crashes in a process that has loaded torch, or that imports cv2 after pycolmap (both bundle
libpng and zlib). Functions that use incompatible libraries run in separate processes, and so do
readers of files from others: native ones crash on damaged files, and any of them may take more time
or memory than there is (``Limits``).
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from pipeline.runtime import progress
from pipeline.runtime.errors import UserError
from pipeline.runtime.memory import limit_address_space, share_heap

T = TypeVar("T")

# Flags of unshare(2).
_NEW_USER, _NEW_NETWORK = 0x10000000, 0x40000000


@dataclass(frozen=True)
class Limits:
    """What a function in a process of its own may use.

    Attributes:
        seconds: The time until the process is ended, or None.
        memory: The bytes of address space beyond those of the idle process, or None (Linux).
        network: Whether it may use the network. Where the kernel does not let a process give up its
            network, it keeps it.
    """

    seconds: float | None = None
    memory: int | None = None
    network: bool = True


_UNLIMITED = Limits()

#: Held while ``__main__`` is hidden from a process that starts.
_MAIN_MODULE = threading.Lock()


class ProcessDied(RuntimeError):
    """The process of a function ended without a result: a crash of native code."""


class OverLimitError(ProcessDied):
    """The function needed more time or memory than its ``Limits``; the message says which."""


def run_isolated(function: Callable[..., T], /, *args: Any, **kwargs: Any) -> T:
    """Call ``function(*args, **kwargs)`` in a new (spawned) process and return its value.

    The function, its arguments and its value must be picklable. The new process imports the
    function's module only: a program of the user's needs no ``if __name__ == "__main__"``. Progress
    is written to the same file. The process ends when the calling process ends, even by SIGKILL.

    Raises:
        UserError: The function raised it.
        RuntimeError: the function raised another exception; the message has its traceback.
        ProcessDied: the process died.
    """
    return run_limited(_UNLIMITED, function, *args, **kwargs)


def run_limited(limits: Limits, function: Callable[..., T], /, *args: Any, **kwargs: Any) -> T:
    """``run_isolated`` with limits of time, memory and network.

    Raises:
        OverLimitError: the function exceeded a limit. Its process has ended.
        UserError, RuntimeError, ProcessDied: See ``run_isolated``.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    # The operating system closes the parent's end of this pipe when the parent ends.
    parent_alive, held_by_parent = context.Pipe(duplex=False)
    # The call is unpickled, which imports its module, after the process has given up its network:
    # a process that has threads cannot.
    call = pickle.dumps((function, args, kwargs))
    process = context.Process(
        target=_child, args=(sender, parent_alive, progress._file, limits, call)
    )
    _start(process, function)
    sender.close()
    parent_alive.close()
    name = function.__qualname__
    try:
        if not receiver.poll(limits.seconds):
            process.kill()
            raise OverLimitError(f"{name} took longer than {limits.seconds:.0f} s")
        status, value = receiver.recv()
    except EOFError:
        process.join()
        raise ProcessDied(f"{name} {_death(process.exitcode)}") from None
    finally:
        if sys.exc_info()[0] is KeyboardInterrupt:
            process.terminate()
        process.join()
        held_by_parent.close()
        receiver.close()
    if status == "user error":
        raise UserError(value["what"], file=value["file"], fix=value["fix"])
    if status == "memory" and limits.memory is not None:
        raise OverLimitError(f"{name} needed more than {limits.memory >> 20} MiB of memory")
    if status != "value":
        raise RuntimeError(f"{name} failed:\n{value}")
    result: T = value
    return result


def _start(process: BaseProcess, function: Callable[..., Any]) -> None:
    """Start the process without the main module, which ``multiprocessing`` would run again."""
    if function.__module__ == "__main__":
        process.start()
        return
    with _MAIN_MODULE:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            process.start()
        finally:
            sys.modules["__main__"] = main


def _child(
    results: Connection,
    parent_alive: Connection,
    progress_file: Path | None,
    limits: Limits,
    call: bytes,
) -> None:
    if not limits.network:
        _give_up_network()
    threading.Thread(target=_exit_with_parent, args=(parent_alive,), daemon=True).start()
    progress.write_progress_to(progress_file)
    if progress_file is not None:
        sys.stderr = progress.Console(sys.stderr, None)  # type: ignore[assignment]
    try:
        function, args, kwargs = pickle.loads(call)
        if limits.memory is not None:
            share_heap()  # Heaps of threads take address space that they do not use.
            limit_address_space(limits.memory)
        results.send(("value", function(*args, **kwargs)))
    except UserError as error:
        results.send(("user error", {"what": error.what, "file": error.file, "fix": error.fix}))
    except MemoryError:
        results.send(("memory", traceback.format_exc()))
    except Exception:
        results.send(("error", traceback.format_exc()))
    if isinstance(sys.stderr, progress.Console):
        sys.stderr.clear()
    # Skip the destructors of extension libraries: they may crash.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _give_up_network() -> None:
    """Move this process to a network without interfaces, where the kernel allows it (Linux)."""
    libc = ctypes.CDLL(None)
    if sys.platform == "linux" and hasattr(libc, "unshare") and libc.unshare(_NEW_NETWORK) != 0:
        # Without privileges, this is possible only in a user namespace.
        libc.unshare(_NEW_USER | _NEW_NETWORK)


def _exit_with_parent(parent_alive: Connection) -> None:
    wait([parent_alive])
    os._exit(1)


def _death(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"died by signal {signal.Signals(-exit_code).name} (out of memory, perhaps)"
    return f"ended without a result (exit code {exit_code})"
