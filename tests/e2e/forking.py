"""``python -m MODULE`` in a fork of a process that has imported large packages already.

The server imports nothing of the program: each fork imports it from its own folder.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import runpy
import select
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path


class ForkServer:
    """Runs modules one after the other, each in a new process with the given packages imported.

    The server ends with the process that made it, whose end closes the server's standard input.
    """

    def __init__(self, *packages: str):
        self._packages = packages
        self._process: subprocess.Popen[str] | None = None
        self._lock = threading.Lock()

    def run(
        self,
        module: str,
        arguments: Sequence[str],
        *,
        folder: Path,
        environment: Mapping[str, str],
        output: Path,
        timeout_s: float,
    ) -> int:
        """The exit status of ``python -m module`` in ``folder``; minus the signal that killed it.

        Args:
            output: file that receives stdout and stderr.
        """
        request = {
            "module": module,
            "arguments": [*arguments],
            "folder": str(folder),
            "environment": dict(environment),
            "output": str(output),
        }
        with self._lock:
            if self._process is None:
                self._process = self._start()
            server = self._process
            assert server.stdin is not None and server.stdout is not None
            server.stdin.write(json.dumps(request) + "\n")
            server.stdin.flush()
            if not select.select([server.stdout], [], [], timeout_s)[0]:
                os.killpg(server.pid, 9)
                self._process = None
                raise AssertionError(f"python -m {module} did not end within {timeout_s} s")
            return int(server.stdout.readline())

    def _start(self) -> subprocess.Popen[str]:
        server = subprocess.Popen(
            [sys.executable, __file__, *self._packages],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert server.stdin is not None
        atexit.register(server.stdin.close)
        return server


def serve(packages: Sequence[str]) -> None:
    """Answer each request, a line of JSON, with the exit status of its process."""
    for package in packages:
        importlib.import_module(package)
    while line := sys.stdin.readline():
        pid = os.fork()
        if pid == 0:
            _become(**json.loads(line))
            return
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


def _become(
    module: str, arguments: list[str], folder: str, environment: dict[str, str], output: str
) -> None:
    """Run a module in this process as ``python -m`` would."""
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[0] = folder
    nothing, file = os.open(os.devnull, os.O_RDONLY), os.open(output, os.O_WRONLY | os.O_CREAT)
    for source, target in ((nothing, 0), (file, 1), (file, 2)):
        os.dup2(source, target)
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    serve(sys.argv[1:])
