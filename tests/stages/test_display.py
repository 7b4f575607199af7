"""The lines of a run on the terminal: each stage once, errors once, and live lines that go away."""

from __future__ import annotations

import io
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.config.schema import Config
from pipeline.plan.scan import scan
from pipeline.runtime.facts import run_record
from pipeline.runtime.progress import ProgressState, progress_file
from pipeline.runtime.record import RUN, STAGE, StageRecord
from stages.workflow import screen
from stages.workflow.display import RunDisplay
from stages.workflow.screen import Screen
from tests.pictures import photos
from tests.plans import make_plan

COUNTERS = {"num_pairs": 3, "num_verified": 2, "median_inliers": 41, "components": [3]}
COUNTERS |= {"isolated": [], "num_cameras": 1}


class Run:
    """A run of stages of ``garden`` and ``yard``, whose jobs a test ends."""

    def __init__(self, folder: Path, jobs: list[str], live: bool = False) -> None:
        self.results = folder / "results"
        self.terminal = io.StringIO()
        needed = [self._job(*job.split("/")) for job in jobs]
        facts = {"is_quiet": False, "shows_logs": False}
        flow: Any = SimpleNamespace(needed_jobs=lambda: needed, cause=lambda job: "", **facts)
        self.display = RunDisplay(flow, Screen(self.terminal), self.results, time.time() - 1)
        for name in {job.split("/")[0] for job in jobs}:
            photos(folder / name, 3)
            found = scan(folder / name, name, Config(), cache=None)
            self.display.planned(make_plan(found, Config()))
        self.display.start()
        self.display._ended.set()  # Tests look at the files when they have written them.

    def _job(self, run: str, stage: str) -> SimpleNamespace:
        rule, wildcards = SimpleNamespace(name=stage), SimpleNamespace(scene=run)
        return SimpleNamespace(rule=rule, wildcards=wildcards, log=[str(self.log(run, stage))])

    def log(self, run: str, stage: str, text: str = "") -> Path:
        path = self.results / run / "logs" / f"{stage}.log"
        if text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return path

    def finish(self, run: str, stage: str, *warnings: str) -> None:
        folder = self.results / run / stage
        folder.mkdir(parents=True)
        facts = {"key": {}, "inputs": {}, "outputs": {}, "decisions": ("decided",)}
        record = StageRecord(
            stage=stage, scene=run, counters=COUNTERS, warnings=warnings, version=1, **facts
        )
        (folder / STAGE).write_text(record.model_dump_json())
        (folder / RUN).write_text(
            run_record(1.25, threads=1, seed=None, timings={}).model_dump_json()
        )

    def shown(self) -> str:
        self.display.poll()
        return self.terminal.getvalue()


def test_a_finished_stage_is_one_line_and_each_warning_is_shown_once(tmp_path: Path) -> None:
    run = Run(tmp_path, ["garden/matches"])
    run.finish("garden", "matches", "few photographs overlap")
    assert run.shown() == run.shown()
    lines = run.shown().splitlines()
    assert lines[0] == "garden: 3 photographs; poses: none"
    found = "matches    2 of 3 pairs verified, with a median of 41 inliers"
    assert [line for line in lines if found in line] == [f"  {found:<70} {'1.2 s':>7}"]
    assert lines.count("  warning: few photographs overlap") == 1


def test_an_error_is_shown_once_and_that_of_another_configuration_by_its_name(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path, ["garden/sfm", "yard/sfm"])
    error = "error in sfm of {}: no model\n  what to do: photograph more\n"
    for name in ("garden", "yard"):
        log = run.log(name, "sfm", error.format(name))
        run.display.job_failed(log, "its command returned non-zero exit status 2")
        run.display.job_failed(log, "its command returned non-zero exit status 2")
    assert run.shown().count("no model") == 1
    assert "error in sfm of yard: as in sfm of garden\n" in run.shown()


@pytest.mark.parametrize(
    ("text", "end", "shown"),
    [
        ("one\nValueError: no\n", "its command returned non-zero exit status 1", "ValueError: no"),
        ("", "its command died: it was killed, as for want of memory", "want of memory; see"),
        ("", "its command returned non-zero exit status 2", None),
        ("sfm: stopped at photograph 2 of 3\n", "it was interrupted", None),
    ],
)
def test_a_job_without_a_message_is_shown_by_the_end_of_its_command_and_its_log(
    tmp_path: Path, text: str, end: str, shown: str | None
) -> None:
    run = Run(tmp_path, ["garden/sfm"])
    before = run.shown()
    run.display.job_failed(run.log("garden", "sfm", text or "\n"), end)
    told = run.shown().removeprefix(before)
    assert (shown in told and "logs/sfm.log" in told) if shown else told == ""


def test_a_stopped_run_names_the_step(tmp_path: Path) -> None:
    run = Run(tmp_path, ["garden/train"])
    run.log("garden", "train", "train: stopped at step 702 of 1500\n")
    assert run.display.interrupted()
    expected = "stopped in train at step 702 of 1500: the same command continues\n"
    assert run.terminal.getvalue().endswith(expected)


def test_live_lines_show_running_jobs_and_are_erased(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(screen, "is_interactive", lambda stream: True)
    run = Run(tmp_path, ["garden/matches"])
    state = ProgressState(
        label="matching", done=3, total=9, unit="pairs", rate=2.0, seconds_left=3.0, note=""
    )
    path = progress_file(run.results / "garden", "matches")
    path.parent.mkdir(parents=True)
    path.write_text(state.model_dump_json())
    line = "  matches    matching: pair 3 of 9, 3.0 s left\n"
    assert run.shown().endswith(line)
    run.finish("garden", "matches")
    erased = run.shown().rpartition(line)[2]
    assert erased.startswith("\x1b[1A\r\x1b[J  matches    2 of 3 pairs") and "left" not in erased


def test_a_closed_terminal_is_no_error(tmp_path: Path) -> None:
    run = Run(tmp_path, ["garden/matches"])
    run.terminal.close()
    run.finish("garden", "matches")
    run.display.poll()
