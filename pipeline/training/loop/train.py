"""Training from the inputs to the result.

The result depends on the inputs, the options and the seed to the last bit; not on the number of
threads, on when checkpoints were written, or on how often the run was interrupted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pipeline.config.settled import TrainOptions
from pipeline.render import Backend, make_backend
from pipeline.render.resident import TrainingSize
from pipeline.runtime import termination
from pipeline.runtime.errors import UserError
from pipeline.runtime.torch_threads import single_torch_thread
from pipeline.scene.views import View
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.device_step import DeviceStep
from pipeline.training.loop.result import TrainResult, result_of
from pipeline.training.loop.session import Session
from pipeline.training.loop.setup import initial_state, load_scene
from pipeline.training.loop.trainer import Trainer
from pipeline.training.run import TrainingRun

Log = Callable[[str], None]


def train(
    inputs: Inputs, run: TrainingRun, log: Log = lambda text: None, backend: Backend | None = None
) -> TrainResult:
    """Optimise the initial Gaussians so that their renders match the views.

    Args:
        log: The function that logs each warning, the instruction set and the time per step.
        backend: The rasterizer's backend; None: the backend of ``run.options.device``.

    Raises:
        UserError: There are no views or no Gaussians, an image cannot be read, no view sees a
            Gaussian, the loss is not finite, or no Gaussian is left.
    """
    if not inputs.views or not len(inputs.initial):
        raise UserError(
            f"expected views and Gaussians to train; found {len(inputs.views)} views and "
            f"{len(inputs.initial)} Gaussians",
            fix="check the split and the initialisation",
        )
    backend = backend or make_backend(run.options.device)
    backend.save_memory(run.is_part)
    warnings: list[str] = []

    def warn(text: str) -> None:
        warnings.append(text)
        log(text)

    with single_torch_thread():
        scene = load_scene(inputs, run, warn)
        backend.release_memory()  # The layers around a block were rendered with it.
        state = initial_state(scene, run, backend, warn)
        session = Session(inputs, state, run, backend.facts(), log)
        trainer = Trainer(scene, state, run, backend)
        log_device(trainer, inputs.views, log)
        with termination.deferred():
            while state.clock < run.span.stop:
                before = state.clock
                trainer.step()
                session.after_step(before, trainer.factor(), trainer.settle, trainer.fetch)
        trainer.finish()
        # The overviews of a block may show only Gaussians of other blocks.
        if state.counters.blind_steps and inputs.open_layers is None:
            warn(f"in {state.counters.blind_steps} steps the view saw no Gaussian")
        return result_of(state, scene, trainer.schedule.sh_degree, warnings, backend.facts())


def log_device(trainer: Trainer, views: Sequence[View], log: Log) -> None:
    """Log the memory that a device needs, or that a GPU cannot train by itself."""
    options = trainer.run.options
    if isinstance(trainer.engine, DeviceStep):
        log(trainer.engine.training.memory_line(training_size(views, options)))
    elif options.device.startswith("gpu"):
        log("the GPU computes operator by operator: the run needs the processor in each step")


def training_size(views: Sequence[View], options: TrainOptions) -> TrainingSize:
    """The size of a training at full resolution and SH degree."""
    pixels = [view.width * view.height for view in views]
    bands = (options.sh_degree + 1) ** 2
    return TrainingSize(options.density.max_gaussians, bands, max(pixels), 3 * sum(pixels))
