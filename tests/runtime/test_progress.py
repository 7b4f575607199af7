"""Progress: one line in its place for a person, lines in the log, silence in CI."""

import io
import os
import subprocess
import sys

import pytest

from pipeline.runtime import progress
from pipeline.runtime.progress import Console, Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def watched(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setattr(progress, "LIVE_SECONDS", 0.0)


def work(monkeypatch, console, count=3):
    monkeypatch.setattr(sys, "stderr", console)
    counter = Progress("matching", count, "pairs")
    for _ in range(count):
        counter.advance(note="fine")
    print("a decision", file=sys.stderr)


def shown(text: str) -> list[str]:
    """What a terminal shows in the end, line by line."""
    return [line.rpartition("\r\x1b[K")[2] for line in text.split("\n")]


def test_a_person_sees_one_line_that_makes_way_for_messages(monkeypatch, watched):
    terminal, log = Terminal(), io.StringIO()
    work(monkeypatch, Console(terminal, log, "fox: "))
    assert terminal.getvalue().count("\r\x1b[Kfox: matching: ") == 3
    assert shown(terminal.getvalue()) == ["a decision", ""]
    assert "\r" not in log.getvalue()
    assert log.getvalue().splitlines()[0].startswith("matching: 3/3 pairs")
    assert log.getvalue().splitlines()[1:] == ["a decision"]


@pytest.mark.parametrize("silent", ["CI", "TERM", "pipe"])
def test_nobody_watching_hears_messages_alone(monkeypatch, watched, silent):
    if silent == "CI":
        monkeypatch.setenv("CI", "true")
    if silent == "TERM":
        monkeypatch.setenv("TERM", "dumb")
    terminal, log = io.StringIO() if silent == "pipe" else Terminal(), io.StringIO()
    work(monkeypatch, Console(terminal, log))
    assert terminal.getvalue() == "a decision\n"
    assert "matching: 3/3 pairs" in log.getvalue()


def test_a_line_never_wraps(monkeypatch, watched):
    monkeypatch.setenv("COLUMNS", "20")
    terminal = Terminal()
    Console(terminal, None, "a very long name of a scene: ").progress("x" * 100, keep=False)
    assert len(shown(terminal.getvalue())[0]) == 19


def test_a_terminal_that_went_away_ends_nothing(monkeypatch, watched):
    class Gone(Terminal):
        def write(self, text: str) -> int:
            raise OSError("gone")

    log = io.StringIO()
    work(monkeypatch, Console(Gone(), log))
    assert "a decision" in log.getvalue()


def test_time_left_follows_the_rate_of_late(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    counter = Progress("training", 10_000, "steps")
    for seconds in [0.01] * 1000 + [0.1] * 600:
        clock[0] += seconds
        counter.advance()
    assert counter.rate() == pytest.approx(10, rel=0.05)
    assert counter.seconds_left() == pytest.approx(840, rel=0.05)


def test_a_stage_on_a_real_terminal(tmp_path):
    """Through run_stage and a pseudo terminal; and nothing with CI set."""
    code = f"""
from pathlib import Path
from pipeline.runtime import progress
from pipeline.runtime.job import Request, run_stage
progress.LIVE_SECONDS = 0.0
def work(job):
    for _ in progress.track(range(5), "working", 5):
        pass
out = Path({str(tmp_path)!r}) / "fox" / "train"
request = Request("train", {{"seed": 0}}, {{}}, out, 1, out.parent / "log", {{}})
raise SystemExit(run_stage(request, work))
"""
    seen = {}
    for ci in ("", "1"):
        leader, follower = os.openpty()
        environment = os.environ | {"TERM": "xterm", "CI": ci, "PYTHONPATH": os.getcwd()}
        command = [sys.executable, "-c", code + f"# {ci}"]
        (tmp_path / "fox" / "train" / ".stage.json").unlink(missing_ok=True)
        assert subprocess.run(command, env=environment, stderr=follower).returncode == 0
        os.close(follower)
        seen[ci] = b""
        while True:
            try:
                seen[ci] += os.read(leader, 4096)
            except OSError:
                break
        os.close(leader)
    assert b"\r\x1b[Kfox: working: 5/5 it" in seen[""]
    assert seen[""].endswith(b"\r\x1b[K")
    assert seen["1"] == b""
    assert "working: 5/5 it" in (tmp_path / "fox/log").read_text()
