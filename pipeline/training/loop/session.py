"""A run in one process: resuming from a checkpoint, saving checkpoints, logs and progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path

from pipeline.runtime import termination
from pipeline.runtime.progress import Progress
from pipeline.training.checkpoints import checkpoint
from pipeline.training.checkpoints.checkpoint import Checkpoint
from pipeline.training.loop.metrics_log import MetricsLog
from pipeline.training.loop.state import CURVE_RECORDS, TrainState
from pipeline.training.loop.step_timer import StepTimer, other_build

CHECKPOINT_SECONDS = 30.0


class Session:
    """Everything around the steps of one process that does not change the result.

    Args:
        part: steps of the schedule, counted from 0.
        build: ``Backend.facts``.
        identity: of the run (``checkpoints.identity``).
        metrics_log: path of the metrics log, or None.
        log: called with each line for the log.
        unit: of the progress bar.
    """

    def __init__(
        self,
        state: TrainState,
        part: range,
        *,
        build: Mapping[str, str],
        identity: str,
        checkpoint_dir: Path,
        metrics_log: Path | None,
        log: Callable[[str], None],
        threads: int,
        unit: str,
    ):
        self.state, self.part, self.log = state, part, log
        self.identity, self.checkpoint_dir = identity, checkpoint_dir
        self.build = dict(build)
        self._resume()
        self.started = self.saved = time.monotonic()
        self.seconds_before = state.seconds
        self.progress = Progress("training", len(part), unit=unit)
        self.progress.start_at(state.clock - part.start)
        self.metrics_log = MetricsLog(metrics_log, state.step)
        self.timer = StepTimer(self.build, threads, part.stop - state.clock)

    def after_step(self, before: int, factor: int) -> None:
        """Log, record and save what is due after a step.

        Args:
            before: ``state.clock`` before the step.
            factor: by which images are reduced.
        """
        state, last = self.state, self.part.stop
        now = time.monotonic()
        state.seconds = self.seconds_before + now - self.started
        if text := self.timer.after_step(state.seconds, factor):
            self.log(text)
        interval = max(1, len(self.part) // CURVE_RECORDS)
        if state.clock // interval > before // interval or state.clock == last:
            state.record()
        if now - self.saved >= CHECKPOINT_SECONDS and state.clock < last:
            self._save()
            self.saved = now
        self.progress.advance(state.clock - before, note=self._note())
        self.metrics_log.write(state, last, factor, self.progress.seconds_left())
        if termination.requested():
            self._save()
            self.log(f"terminated after {state.step} steps, which a checkpoint keeps")
            raise termination.Terminated

    def _resume(self) -> None:
        # Messages on checkpoints are logged only: they are not part of the result.
        found = checkpoint.load_latest(self.checkpoint_dir, self.identity, self.log)
        if found is None:
            return
        try:
            self.state.restore(found.step, found.arrays, found.values)
        except ValueError as error:
            self.log(
                f"{self.checkpoint_dir}: the checkpoint of step {found.step} is not used, because "
                f"it is not one of this run: {error}"
            )
            return
        if text := other_build(found.values, self.build):
            self.log(text)

    def _save(self) -> None:
        state = self.state
        values = state.values() | {"built": self.build}
        saved = Checkpoint(state.step, self.identity, state.arrays(), values)
        checkpoint.save(self.checkpoint_dir, saved)

    def _note(self) -> str:
        text = f"{len(self.state.gaussians)} Gaussians"
        if self.state.curve:
            last = self.state.curve[-1]
            text = f"loss {last.loss:.4f}, PSNR {last.psnr:.2f} dB, {text}"
        return text
