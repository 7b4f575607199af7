"""Training from the inputs to the result.

The result depends on the inputs, the options and the seed to the last bit; not on the number of
threads, on when checkpoints were written, or on how often the run was interrupted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from pipeline.config.experiments import TrainExperiments
from pipeline.config.schema import Train
from pipeline.render import Backend, make_backend
from pipeline.render.resident import TrainingSize
from pipeline.runtime import termination
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View
from pipeline.training.checkpoints.identity import identity_of
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.result import TrainResult, result_of
from pipeline.training.loop.schedule import WHOLE_RUN, Part, Schedule
from pipeline.training.loop.session import Session
from pipeline.training.loop.setup import initial_state, load_scene
from pipeline.training.loop.trainer import Trainer


def train(
    inputs: Inputs,
    config: Train,
    experiments: TrainExperiments,
    *,
    seed: int,
    threads: int,
    memory_mb: int | None = None,
    checkpoint_dir: Path,
    metrics_log: Path | None = None,
    on_log: Callable[[str], None] | None = None,
    backend: Backend | None = None,
    part: Part = WHOLE_RUN,
) -> TrainResult:
    """Optimise the initial Gaussians so that their renders match the views.

    Resumes from the newest checkpoint of the same run in ``checkpoint_dir``; the caller deletes the
    folder when the result is stored.

    Args:
        threads: of the native operators. torch itself runs on one, so that sums do not change.
        memory_mb: memory limit of training: images that do not fit beside the Gaussians are read
            from a temporary file, which changes no result. None: three quarters of the memory of
            the machine or container, which is the limit in any case.
        metrics_log: file for the progress (``training.loop.metrics_log``).
        on_log: called with each warning, and with the instruction set and the time per step.
        backend: of the rasterizer; None: of ``config.device``.
        part: of the schedule.

    Raises:
        UserError: no views or no Gaussians, unreadable images, no view sees a Gaussian, the loss is
            not finite, or no Gaussian is left.
    """
    if not inputs.views or not len(inputs.initial):
        raise UserError(
            f"expected views and Gaussians to train; found {len(inputs.views)} views and "
            f"{len(inputs.initial)} Gaussians",
            fix="check the split and the initialisation",
        )
    backend = backend or make_backend(config.device)
    backend.save_memory(part != WHOLE_RUN)  # A scene is divided where memory is short.
    log = on_log or (lambda text: None)
    warnings: list[str] = []

    def warn(text: str) -> None:
        warnings.append(text)
        log(text)

    if config.depth_loss_weight in (0, "auto"):  # the plan settles "auto"
        inputs = replace(inputs, depths=None)
    identity = identity_of(inputs, config, experiments, seed)
    torch_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        scene = load_scene(
            inputs,
            config,
            experiments,
            seed=seed,
            threads=threads,
            memory_mb=memory_mb,
            part=part,
            warn=warn,
        )
        backend.release_memory()  # That the layers around a block were rendered with.
        steps = Schedule.of(config, experiments).steps
        span = part.of(steps)
        state = initial_state(
            scene, config, experiments, backend, steps=steps, start=span.start, seed=seed, warn=warn
        )
        session = Session(
            state,
            span,
            build=backend.facts(),
            identity=identity,
            checkpoint_dir=checkpoint_dir,
            metrics_log=metrics_log,
            log=log,
            threads=threads,
            unit="steps" if config.budget_minutes is None else "parts",
        )
        trainer = Trainer(scene, state, config, experiments, backend, threads, span)
        if trainer.device is not None:
            log(trainer.device.training.memory_line(training_size(inputs.views, config)))
        elif config.device.startswith("gpu"):
            log("the GPU computes operator by operator: the run needs the processor in each step")
        with termination.deferred():
            while state.clock < span.stop:
                before = state.clock
                trainer.step()
                session.after_step(before, trainer.factor())
        state.fetch()
        backend.release_memory()
        # With a limit of gradients per pixel, Gaussians that are seen may have none.
        if not experiments.gradients_per_pixel:
            state.drop_unseen(len(scene.views), scene.sky)
        trainer.clear_camera_path()
        # Of a block, overviews see nothing where others are in front of it.
        if state.counters.blind_steps and inputs.open_layers is None:
            warn(f"in {state.counters.blind_steps} steps the view saw no Gaussian")
        return result_of(state, scene, config.sh_degree, warnings, backend.facts())
    finally:
        torch.set_num_threads(torch_threads)


def training_size(views: Sequence[View], config: Train) -> TrainingSize:
    """At full resolution and SH degree."""
    pixels = [view.width * view.height for view in views]
    bands = (config.sh_degree + 1) ** 2
    return TrainingSize(config.density.max_gaussians, bands, max(pixels), 3 * sum(pixels))
