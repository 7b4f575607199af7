"""Training steps on a device: which copy of the Gaussians is current."""

from __future__ import annotations

from pipeline.render import Backend
from pipeline.render.resident import Optimised, ResidentStep, ResidentTraining, StepResult
from pipeline.training.loop.state import TrainState


class DeviceSteps:
    """The Gaussians of ``state`` on a device, while steps change them there.

    Before the tensors of ``state`` are read, ``fetch`` makes them current; after they were changed,
    ``invalidate`` makes the next step copy them again.
    """

    def __init__(self, training: ResidentTraining, state: TrainState):
        self.training, self.state = training, state
        self._loaded = False  # The device has what the state has, or newer.
        self._ahead = False

    @staticmethod
    def of(backend: Backend, state: TrainState, *, isotropic: bool) -> DeviceSteps | None:
        """None if the backend computes on the CPU, or if the run needs more in a step than devices
        do: a strategy with its own losses or noise, isotropic Gaussians."""
        if state.density.statistics is None or isotropic:
            return None
        training = backend.resident()
        return None if training is None else DeviceSteps(training, state)

    def step(self, step: ResidentStep) -> StepResult:
        if not self._loaded:
            self.training.load(self._optimised())
            self._loaded = True
        self._ahead = True
        return self.training.step(step)

    def fetch(self) -> None:
        """Copy the device's tensors to ``state``."""
        if self._ahead:
            self.training.store(self._optimised())
            self._ahead = False

    def invalidate(self) -> None:
        """The tensors of ``state`` were changed."""
        assert not self._ahead
        self._loaded = False

    def _optimised(self) -> Optimised:
        state, adam = self.state, self.state.adam
        assert state.density.statistics is not None
        return Optimised(
            state.gaussians.tensors(), adam.first, adam.second, adam.last, *state.density.statistics
        )
