"""A run in one process: resuming from a checkpoint, saving checkpoints, logs and progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from pipeline.runtime import termination
from pipeline.runtime.progress import Progress
from pipeline.training.checkpoints import checkpoint
from pipeline.training.checkpoints.checkpoint import Checkpoint
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.metrics_log import NAME, MetricsLog
from pipeline.training.loop.state import CURVE_RECORDS, TrainState
from pipeline.training.loop.step_timer import StepTimer
from pipeline.training.run import TrainingRun

CHECKPOINT_SECONDS = 30.0


class Session:
    """Everything around the steps of one process that does not change the result.

    Args:
        inputs: The inputs of the run, by which its checkpoints are recognised.
        state: The state before the part. It is restored from the newest checkpoint of the run.
        build: ``Backend.facts``.
        log: The function that is called with each line for the log.
    """

    def __init__(
        self,
        inputs: Inputs,
        state: TrainState,
        run: TrainingRun,
        build: Mapping[str, str],
        log: Callable[[str], None],
    ) -> None:
        self.state, self.run, self.log, self.build = state, run, log, dict(build)
        self.identity = checkpoint.identity_of(inputs, run)
        found = checkpoint.load_latest(run.checkpoint_dir, self.identity, log)
        if found is not None:
            self._resume(found, checkpoint.other_build(found.values, self.build))
        self.started = self.saved = time.monotonic()
        self.seconds_before = state.seconds
        unit = "steps" if run.options.budget_minutes is None else "parts"
        self.progress = Progress("training", len(run.span), unit=unit)
        self.progress.start_at(state.clock - run.span.start)
        self.metrics_log = MetricsLog(run.logs and run.logs / NAME, state.step)
        self.timer = StepTimer(self.build, run.threads, run.span.stop - state.clock)

    def after_step(
        self, before: int, factor: int, settle: Callable[[], None], fetch: Callable[[], None]
    ) -> None:
        """Log, record and save what is due after a step.

        Args:
            before: ``state.clock`` before the step.
            factor: The factor by which images are reduced.
            settle: The function that makes the figures of the state current (``Trainer.settle``).
            fetch: The function that makes all of the state current (``Trainer.fetch``).
        """
        state, last = self.state, self.run.span.stop
        now = time.monotonic()
        state.seconds = self.seconds_before + now - self.started
        if text := self.timer.after_step(state.seconds, factor):
            self.log(text)
        interval = max(1, len(self.run.span) // CURVE_RECORDS)
        if state.clock // interval > before // interval or state.clock == last:
            settle()
            state.record()
        if now - self.saved >= CHECKPOINT_SECONDS and state.clock < last:
            self._save(fetch)
            self.saved = now
        if termination.requested():
            self._save(fetch)
            self.log(f"stopped after {state.step} steps, which a checkpoint keeps")
            termination.check()
        self.progress.advance(state.clock - before, note=self._note())
        self.metrics_log.write(state, last, factor, self.progress.seconds_left())

    def _resume(self, found: Checkpoint, other_build: str | None) -> None:
        # Messages on checkpoints are logged only: they are not part of the result.
        try:
            self.state.restore(found.step, found.arrays, found.values)
        except ValueError as error:
            self.log(
                f"{self.run.checkpoint_dir}: the checkpoint of step {found.step} is not used, "
                f"because it is not one of this run: {error}"
            )
            return
        if other_build:
            self.log(other_build)

    def _save(self, fetch: Callable[[], None]) -> None:
        fetch()
        state = self.state
        values = state.values() | {"built": self.build}
        saved = Checkpoint(state.step, self.identity, state.arrays(), values)
        checkpoint.save(self.run.checkpoint_dir, saved)

    def _note(self) -> str:
        text = f"{len(self.state.gaussians)} Gaussians"
        if self.state.curve:
            last = self.state.curve[-1]
            text = f"loss {last.loss:.4f}, PSNR {last.psnr:.2f} dB, {text}"
        return text
