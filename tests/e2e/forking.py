"""``python -m MODULE`` in a fork of a process that has imported large packages already.

The server imports nothing of the program: each fork imports it from its own folder.

    python forking.py serve ADDRESS PACKAGE...     # the server
    python forking.py call ADDRESS -m MODULE ...   # as python -m MODULE ..., in a fork
"""

from __future__ import annotations

import atexit
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
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path


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

    @staticmethod
    def _end(server: subprocess.Popen[bytes], folder: Path) -> None:
        assert server.stdin is not None
        server.stdin.close()
        server.wait()
        shutil.rmtree(folder, ignore_errors=True)

    def python(self, starts: Sequence[str]) -> Path:
        """A ``python`` that runs a command that begins with one of ``starts``, each ``-m MODULE``
        and an argument, in a fork. Others start a new process."""
        script = self._folder / "bin" / "python"
        if not script.exists():
            script.parent.mkdir()
            here, real = shlex.quote(__file__), shlex.quote(sys.executable)
            address = shlex.quote(str(self._folder / "socket"))
            script.write_text(
                f'#!/bin/sh\ncase "$1 $2 $3" in\n{"|".join(map(shlex.quote, starts))})\n'
                f'exec {real} -I -S {here} call {address} "$@";;\nesac\nexec {real} "$@"\n'
            )
            script.chmod(0o755)
        return script

    def run(
        self,
        module: str,
        arguments: Sequence[str],
        *,
        folder: Path,
        environment: Mapping[str, str],
        output: int,
        timeout_s: float,
        python: Path,
    ) -> int:
        """The exit status of ``python -m module``; minus the signal that killed it.

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
        }
        with open(os.devnull) as nothing:
            files = [nothing.fileno(), output, output]
            try:
                return _call(str(self._folder / "socket"), request, files, timeout_s)
            except TimeoutError:
                os.killpg(self._server.pid, signal.SIGKILL)
                raise


def _call(address: str, request: object, files: list[int], timeout_s: float | None) -> int:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(timeout_s)
        connection.connect(address)
        socket.send_fds(connection, [b"."], files)
        connection.sendall(json.dumps(request).encode())
        connection.shutdown(socket.SHUT_WR)
        return int(connection.recv(16))


def call(address: str, module: str, *arguments: str) -> int:
    """Run a module with this process's folder, environment and files."""
    request = {
        "module": module,
        "arguments": arguments,
        "folder": os.getcwd(),
        "environment": dict(os.environ),
    }
    code = _call(address, request, [0, 1, 2], None)
    return code if code >= 0 else 128 - code


def serve(address: str, *packages: str) -> None:
    """Run what is requested, each in a process of its own, until standard input is closed."""
    for package in packages:
        importlib.import_module(package)
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
    """Run one request in a child and send its exit status."""
    _, files, _, _ = socket.recv_fds(connection, 1, 3)
    with connection.makefile("rb") as stream:
        request = json.load(stream)
    pid = os.fork()
    if pid == 0:
        connection.close()
        _become(files, **request)
        return
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    connection.sendall(str(code).encode())
    os._exit(0)


def _become(
    files: Sequence[int],
    module: str,
    arguments: Sequence[str],
    folder: str,
    environment: Mapping[str, str],
    python: str = sys.executable,
) -> None:
    """Run a module in this process as ``python -m`` would."""
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[0] = folder
    sys.executable = python
    for target, file in enumerate(files):
        os.dup2(file, target)
        os.close(file)
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(*sys.argv[2:])
    else:
        sys.exit(call(sys.argv[2], *sys.argv[4:]))
