"""``python -m MODULE`` in a fork of a process that has imported large packages already.

Modules of the program that the server has imported are used by forks in folders whose program is
this one, by symbolic links. Forks in a folder with a program of its own import that one.

    python forking.py serve ADDRESS PACKAGE...     # the server
    python forking.py call ADDRESS -m MODULE ...   # as python -m MODULE ..., in a fork
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import runpy
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = ("pipeline", "stages")


class ForkServer:
    """Runs modules in processes that have imported the given packages.

    The server starts at its first use, and ends when the process that made it ends.
    """

    def __init__(self, *packages: str):
        self._packages = packages

    @cached_property
    def _folder(self) -> Path:
        """The folder of the server's socket, once it listens."""
        folder = Path(tempfile.mkdtemp(prefix="forks-"))
        server = subprocess.Popen(
            [sys.executable, __file__, "serve", str(folder / "socket"), *self._packages],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert server.stdin is not None and server.stdout is not None
        atexit.register(self._end, server, folder)
        assert server.stdout.readline() == b"ready\n"
        self._server = server
        return folder

    @property
    def address(self) -> Path:
        """The server's socket."""
        return self._folder / "socket"

    @staticmethod
    def _end(server: subprocess.Popen[bytes], folder: Path) -> None:
        assert server.stdin is not None
        server.stdin.close()
        server.wait()
        shutil.rmtree(folder, ignore_errors=True)

    def handles(self, starts: Sequence[str]) -> str:
        """A branch of a shell's ``case "$1 $2 $3"``: these commands, each ``-m MODULE`` and an
        argument, run in a fork."""
        call = shlex.join([sys.executable, "-I", "-S", __file__, "call", str(self.address)])
        return f'{"|".join(map(shlex.quote, starts))})\nexec {call} "$@";;\n'

    def start(
        self,
        module: str,
        arguments: Sequence[str],
        *,
        folder: Path,
        environment: Mapping[str, str],
        output: int,
        python: Path,
    ) -> Fork:
        """``python -m module`` in a session of its own.

        Args:
            output: descriptor of the file that receives stdout and stderr.
            python: what the process takes for its interpreter.
        """
        request = {
            "module": module,
            "arguments": [*arguments],
            "folder": str(folder),
            "environment": dict(environment),
            "python": str(python),
            "session": True,
        }
        with open(os.devnull) as nothing:
            return Fork(str(self.address), request, [nothing.fileno(), output, output])


class Fork:
    """A module that runs in a fork of a server, which kills it if this process ends.

    Attributes:
        pid: its process.
    """

    def __init__(self, address: str, request: object, files: list[int]):
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(address)
            socket.send_fds(connection, [b"."], files)
            connection.sendall(json.dumps(request).encode())
            connection.shutdown(socket.SHUT_WR)
            self._answers = connection.makefile("rb", buffering=0)
        self.pid = int(self._answers.readline())

    def ended(self, timeout_s: float | None = 0.0) -> bool:
        return bool(select.select([self._answers], [], [], timeout_s)[0])

    def wait(self, timeout_s: float | None = None) -> int:
        """The exit status; minus the signal that killed it."""
        if not self.ended(timeout_s):
            os.killpg(self.pid, signal.SIGKILL)
            raise TimeoutError
        with self._answers:
            return int(self._answers.readline())


def write_python(script: Path, *branches: str) -> Path:
    """Write a ``python`` that runs what the branches handle (``ForkServer.handles``) in forks, and
    starts a new process for everything else."""
    script.write_text(
        f'#!/bin/sh\ncase "$1 $2 $3" in\n{"".join(branches)}esac\n'
        f'exec {shlex.quote(sys.executable)} "$@"\n'
    )
    script.chmod(0o755)
    return script


def call(address: str, module: str, *arguments: str) -> int:
    """Run a module with this process's folder, environment and files."""
    request = {
        "module": module,
        "arguments": arguments,
        "folder": os.getcwd(),
        "environment": dict(os.environ),
    }
    code = Fork(address, request, [0, 1, 2]).wait()
    return code if code >= 0 else 128 - code


def serve(address: str, *packages: str) -> None:
    """Run what is requested, each in a process of its own, until standard input is closed."""
    sys.path[0] = str(ROOT)
    for package in packages:
        importlib.import_module(package)
    gc.freeze()  # The forks' collections leave the packages' objects, and their pages, alone.
    children: set[int] = set()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        listener.listen()
        print("ready", flush=True)
        while sys.stdin not in (ready := select.select([listener, sys.stdin], [], [])[0]):
            assert ready
            connection, _ = listener.accept()
            children = {pid for pid in children if os.waitpid(pid, os.WNOHANG)[0] == 0}
            if (child := os.fork()) == 0:
                listener.close()
                _answer(connection)
                return
            children.add(child)
            connection.close()
    for child in children:
        os.waitpid(child, os.WNOHANG)  # counts its processor time


def _answer(connection: socket.socket) -> None:
    """Run one request in a child, send its process and its exit status. If the connection is closed
    before, the child is killed."""
    _, files, _, _ = socket.recv_fds(connection, 1, 3)
    with connection.makefile("rb") as stream:
        request = json.load(stream)
    pid = os.fork()
    if pid == 0:
        connection.close()
        _become(files, **request)
        return
    connection.sendall(b"%d\n" % pid)
    events = select.poll()
    child = os.pidfd_open(pid)
    events.register(child, select.POLLIN)
    events.register(connection, 0)  # a hang-up only
    if all(file != child for file, _ in events.poll()):
        os.kill(pid, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    with contextlib.suppress(BrokenPipeError):
        connection.sendall(b"%d\n" % code)
    os._exit(0)


def _become(
    files: Sequence[int],
    module: str,
    arguments: Sequence[str],
    folder: str,
    environment: Mapping[str, str],
    python: str = sys.executable,
    session: bool = False,
) -> None:
    """Run a module in this process as ``python -m`` would, but for the tear-down of the packages'
    modules and objects, which takes longer than many a stage."""
    if session:
        os.setsid()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[0] = folder
    if Path(folder, PROGRAM[0]).resolve() != ROOT / PROGRAM[0]:
        for name in [name for name in sys.modules if name.split(".")[0] in PROGRAM]:
            del sys.modules[name]
    sys.executable = python
    for target, file in enumerate(files):
        os.dup2(file, target)
        os.close(file)
    sys.argv = [module, *arguments]
    status = 0
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as leaving:
        if not isinstance(leaving.code, int | None):
            raise
        status = leaving.code or 0
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(*sys.argv[2:])
    else:
        sys.exit(call(sys.argv[2], *sys.argv[4:]))
