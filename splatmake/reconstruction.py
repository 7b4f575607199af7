"""Reconstruction of a scene from photographs, by the pipeline in a process of its own."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from pipeline.command.workflow import Running, run_command
from pipeline.config.load import load_project
from pipeline.reporting.metrics import Metrics
from pipeline.runtime.errors import UserError
from pipeline.runtime.termination import Terminated, raising_when_terminated
from splatmake.files import warn
from splatmake.scene import Scene, load

# The number of lines of the pipeline's output that are kept for its error message.
_KEPT_LINES = 2000
# A message of the pipeline, whose further lines are indented.
_MESSAGE = re.compile(r"^error(?:: | in )(.*(?:\n[ \t]+\S.*)*)", re.M)
_SHOWN_LINES = 20


def reconstruct(
    photographs: str | PathLike[str],
    out: str | PathLike[str] = ".",
    *,
    name: str | None = None,
    preset: str | None = None,
    config: Mapping[str, Any] | None = None,
    cores: int | None = None,
    progress: bool = False,
) -> Scene:
    """Reconstruct the scene that photographs show, as ``splatmake run`` does.

    The results of photographs in ``photos/garden`` are in ``<out>/results/garden``, with the page
    ``report.html`` and ``metrics.json``. Finished stages are not run again: a second call with the
    same arguments takes seconds, and one after an interruption continues.

    Args:
        photographs: The folder of photographs of one scene.
        out: The folder that holds ``results/``; made if it does not exist.
        name: The scene's name in the results; None for that of the folder.
        preset: "fast", "balanced", "high" or "original"; None for that of ``config``, else
            "balanced".
        config: Options of the pipeline by section, such as ``{"train": {"steps": 2000}}``. Relative
            paths in it are relative to ``out``.
        cores: The number of processor cores to use, which does not affect results; None for all.
        progress: Whether to show the pipeline's output on ``sys.stderr``.

    Returns:
        The finished scene. Warnings of the pipeline are issued as Python warnings.

    Raises:
        UserError: The folder or an option is wrong, or the pipeline failed, with its message.
        KeyboardInterrupt: The call was interrupted, after the pipeline has ended.
    """
    if cores is not None and cores < 1:
        raise UserError(f"cores: expected 1 or more, or None for all, found {cores}")
    # Snakemake checks the options, too, but takes seconds to start.
    load_project(dict(config or {}) | ({} if preset is None else {"preset": preset}))
    folder, work = Path(os.path.abspath(photographs)), Path(os.path.abspath(out))
    with tempfile.TemporaryDirectory(prefix="splatmake-") as temporary:
        options = []
        if config:
            file = Path(temporary) / "config.json"
            file.write_text(json.dumps(dict(config), default=str))
            options = ["--configfile", str(file)]
        try:
            work.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            what = f"expected a folder for the results: {error.strerror}"
            raise UserError(what, file=work, fix="give another folder as out") from None
        count = "all" if cores is None else str(cores)
        command = run_command(folder, name, Running(work, preset, count, (), None, options))
        code, output = _run(command, work, progress)
    if code != 0:
        raise _failure(folder, code, output)
    results = work / "results" / (name or folder.name)
    scene = load(results)
    warn(Metrics.read(results).warnings)
    return scene


def _run(command: list[str], folder: Path, shown: bool) -> tuple[int, str]:
    """Run a command in ``folder``. Return its exit code and the end of its output."""
    kept: deque[str] = deque(maxlen=_KEPT_LINES)
    # Without PYTHONSAFEPATH, Python looks for packages in the current folder first, the user's.
    environment = os.environ | {"PYTHONSAFEPATH": "1", "NO_COLOR": "1"}
    with (
        subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            process_group=0,
        ) as child,
        _ended_with_this_process(child),
    ):
        assert child.stdout is not None
        for line in child.stdout:
            kept.append(line)
            if shown:
                print(line, end="", file=sys.stderr, flush=True)
    return child.returncode, "".join(kept)


@contextlib.contextmanager
def _ended_with_this_process(child: subprocess.Popen[str]) -> Iterator[None]:
    """If the block is left by an exception, such as KeyboardInterrupt, or this process is asked to
    end, interrupt the child with its own children, as Ctrl-C in a terminal does, and wait until it
    has ended; a second interrupt kills it. The child has a process group of its own: in a notebook,
    an interrupt reaches only this process."""
    try:
        with raising_when_terminated():
            try:
                yield
            except BaseException:
                _signal_group(child, signal.SIGINT)
                child.communicate()
                raise
    except BaseException as error:
        _signal_group(child, signal.SIGKILL)
        if isinstance(error, Terminated):  # What this process does when it is asked to end.
            os.kill(os.getpid(), signal.SIGTERM)
        raise


def _signal_group(child: subprocess.Popen[str], number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, number)


def _failure(folder: Path, code: int, output: str) -> UserError:
    """The error with the last message of the pipeline, or with the end of its output."""
    messages = _MESSAGE.findall(output)
    if messages:
        what, _, fix = messages[-1].partition("\n  what to do: ")
        return UserError(what, fix=fix or None)
    end = "\n".join(output.rstrip().splitlines()[-_SHOWN_LINES:])
    return UserError(
        f"the pipeline ended with code {code}:\n{end}",
        file=folder,
        fix="call reconstruct with progress=True to see all of its output",
    )
