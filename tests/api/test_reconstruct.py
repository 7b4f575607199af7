"""``splatmake.reconstruct`` without the pipeline: output, errors and interruptions of its process.

``tests/install`` runs it with the pipeline.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

import splatmake
from splatmake import UserError, reconstruction


def pipeline(monkeypatch: pytest.MonkeyPatch, code: str) -> list[Any]:
    """Let this Python code be the pipeline; returns the arguments that it is called with."""
    called: list[Any] = []

    def command(*arguments: Any) -> list[str]:
        called.extend(arguments)
        return [sys.executable, "-c", code]

    monkeypatch.setattr(reconstruction, "run_command", command)
    return called


@pytest.mark.parametrize(
    ("output", "what", "fix"),
    [
        ("error: a.jpg: broken\n  what to do: remove it\nmore", "a.jpg: broken", "remove it"),
        ("error in sfm of barn: no poses\nend", "sfm of barn: no poses", None),
        ("error: not valid:\n  a: no\n  b: no\n", "not valid:\n  a: no\n  b: no", None),
        ("error: first\nerror: second", "second", None),
        (
            "Traceback\nKeyError: 3\n",
            "the pipeline ended with code 1:\nTraceback\nKeyError: 3",
            "call reconstruct with progress=True to see all of its output",
        ),
    ],
)
def test_a_failure_is_the_pipelines_last_message(
    output: str, what: str, fix: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline(monkeypatch, f"import sys; print({output!r}); sys.exit(1)")
    with pytest.raises(UserError) as caught:
        splatmake.reconstruct(tmp_path, tmp_path)
    assert (caught.value.what, caught.value.fix) == (what, fix)


@pytest.mark.parametrize("progress", [False, True])
def test_output_is_shown_on_request(
    progress: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    show = "import os, sys; print('training', os.getcwd()); sys.exit(1)"
    called = pipeline(monkeypatch, show)
    with pytest.raises(UserError):
        splatmake.reconstruct("photos", tmp_path / "new", cores=3, progress=progress)
    out, err = capfd.readouterr()
    assert out == "" and err == (f"training {tmp_path / 'new'}\n" if progress else "")
    folder, name, how = called
    assert (folder, name, how.cores) == (Path("photos").absolute(), None, "3")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"cores": 0}, "cores: expected 1 or more"),
        ({"preset": "quick"}, "preset: Input should be 'fast'"),
        ({"config": {"train": {"steps": None}}}, "train.steps: .*found None"),
        ({"out": __file__}, "expected a folder for the results"),
    ],
)
def test_a_wrong_argument_is_an_error_before_the_pipeline_starts(
    wrong: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(subprocess, "Popen")
    with pytest.raises(UserError, match=said):
        splatmake.reconstruct(tmp_path, **wrong)


# A pipeline with a job, which says its process and takes as long as nobody interrupts it.
JOB = "import sys, time; print('job', flush=True); time.sleep(600)"
RUN = f"""
import subprocess, sys
job = subprocess.Popen([sys.executable, "-c", {JOB!r}])
open("job", "w").write(str(job.pid))
job.wait()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_ends_the_pipeline_and_its_jobs(
    number: signal.Signals, tmp_path: Path
) -> None:
    """Only this process gets the signal, as in a notebook."""
    code = (
        "import sys, splatmake\nfrom splatmake import reconstruction\n"
        f"reconstruction.run_command = lambda *_: [sys.executable, '-c', {RUN!r}]\n"
        "splatmake.reconstruct('.', '.')\n"
    )
    user = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(splatmake.__file__).parents[1])},
        stderr=subprocess.PIPE,
        text=True,
        # As in a terminal, also where the tests run in the background of a shell.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    killer = threading.Timer(120, user.kill)
    killer.start()
    while not ((tmp_path / "job").exists() and (tmp_path / "job").read_text()):
        assert user.poll() is None
        time.sleep(0.05)
    user.send_signal(number)
    _, said = user.communicate()
    killer.cancel()
    assert user.returncode == -number
    assert ("KeyboardInterrupt" in said) == (number == signal.SIGINT)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "job").read_text()), 0)
