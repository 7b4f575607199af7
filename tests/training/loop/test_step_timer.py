"""The log line on instruction set and time per step; checkpoints of another instruction set."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.training.checkpoints import checkpoint
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop import session
from pipeline.training.loop.step_timer import (
    MEASURED,
    WARM_UP,
    StepTimer,
)
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from tests.training.conftest import TinyScene, tiny_config

HERE = {"instruction_set": "x86-64-v3", "compiler": "g++ 12.2.0"}
ELSEWHERE = {"instruction_set": "x86-64-v4", "compiler": "g++ 12.2.0"}


def lines(steps: int) -> list[str]:
    """Log lines of a run whose first steps are slow and whose others take 20 ms."""
    timer, seconds, said = StepTimer(HERE, 2, steps), 0.0, []
    for step in range(1, steps + 1):
        seconds += 1.0 if step <= WARM_UP // 2 else 0.02
        said.append(timer.after_step(seconds, 4))
    return [line for line in said if line]


@pytest.mark.parametrize("steps", [WARM_UP + MEASURED, 1000])
def test_the_time_per_step_excludes_the_first_steps_and_is_logged_once(steps: int) -> None:
    (line,) = lines(steps)
    assert line == "x86-64-v3, g++ 12.2.0, 2 threads: 20.0 ms a step, images at 1/4 of their size"


@pytest.mark.parametrize("steps", [1, 2, 7, 20])
def test_short_runs_are_measured_unless_they_have_one_step(steps: int) -> None:
    assert len(lines(steps)) == (steps > 1)


def test_a_checkpoint_of_another_instruction_set_is_logged() -> None:
    assert checkpoint.other_build({}, HERE) is None
    assert checkpoint.other_build({"built": HERE}, HERE) is None
    text = checkpoint.other_build({"built": ELSEWHERE}, HERE)
    assert text is not None and "x86-64-v3" in text and "x86-64-v4" in text


def test_training_resumes_from_a_checkpoint_of_another_instruction_set(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run() -> list[str]:
        said: list[str] = []
        inputs = Inputs(scene.views, scene.initial, scene.extent)
        config = tiny_config(12)
        train(inputs, TrainingRun(config, tmp_path, seed=0, threads=1), log=said.append)
        return said

    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
    assert not any("continues with" in line for line in run())
    kept = checkpoint.newest(tmp_path)
    assert kept is not None
    kept.values["built"] = ELSEWHERE
    checkpoint.save(tmp_path, kept)
    (line,) = [line for line in run() if "continues with" in line]
    assert "x86-64-v4" in line
