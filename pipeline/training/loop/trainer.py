"""The training loop: 3D Gaussian splatting (Kerbl et al. 2023) on the native rasterizer.

Bits depend on the inputs, the settings and the seed alone: not on the number of threads, on when
checkpoints were written, or on how often the run was killed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.config.schema import Train
from pipeline.plan.training_memory import machine_mb, memory_mb
from pipeline.render import Backend, Forward, RasterCamera, RasterOptions, make_backend
from pipeline.render.views import near_plane, raster_camera
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import Progress
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.morton import in_morton_order
from pipeline.training.cameras.refinement import MovingCameras
from pipeline.training.checkpoints import checkpoint
from pipeline.training.checkpoints.checkpoint import Checkpoint
from pipeline.training.checkpoints.identity import identity_of
from pipeline.training.data.image_store import DiskShelf, MemoryShelf, Shelf
from pipeline.training.data.inputs import Inputs
from pipeline.training.data.targets import Target, Targets, usable_factor
from pipeline.training.density import make_strategy
from pipeline.training.density.floaters import fade_floaters
from pipeline.training.loop.metrics_log import Journal
from pipeline.training.loop.schedule import Schedule
from pipeline.training.loop.state import TrainState, Window
from pipeline.training.loop.step_time_estimator import GAUSSIANS_A_STEP, Pace
from pipeline.training.loop.step_timer import StepTimer, other_build
from pipeline.training.losses.depth import depth_gradients
from pipeline.training.optimisers.adam import Adam, Rates

CHECKPOINT_SECONDS = 30.0
CURVE_RECORDS = 100
# PSNR costs a pass over the picture; a sample of the steps is enough for a curve.
PSNR_EVERY = 10
# Drawing depths and their gradients costs a step half as much again; depths change slowly.
DEPTH_EVERY = 4
# Floaters are looked for in all views, at a quarter of their size, four times in a run: as much as
# two looks at each. Runs of fewer looks than this, which make hardly any, do without.
CLEAR_AIR_FACTOR, CLEAR_AIR_LOOKS = 4, 50

Colour = tuple[float, float, float]
BACKGROUNDS: dict[str, Colour] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@dataclass(frozen=True)
class TrainResult:
    """A trained scene.

    Attributes:
        gaussians: with SH of the configured degree.
        curve: {step, loss, psnr, num_gaussians} about every hundredth of the run: means since
            the record before, over training views at the resolution in use. Deterministic.
        curve_seconds: training time of each record; differs from run to run.
        counters: what happened, as plain values (see ``state.Counters``).
        near: the near plane it was trained with; render with the same.
        background: of the training: black, white or random.
        warnings: for a person; deterministic.
        steps: optimiser steps done.
        seconds: training time in all, over every process that worked on it.
        poses: (4, 4) world to camera of each view by name, where they were refined.
        lenses: (3,) change of each camera's lens by id (``Lenses``), where they were refined.
    """

    gaussians: Gaussians
    curve: list[dict[str, float]]
    curve_seconds: list[float]
    counters: dict[str, Any]
    near: float
    background: str
    warnings: list[str]
    steps: int
    seconds: float
    poses: dict[str, NDArray[np.float64]] | None
    lenses: dict[int, NDArray[np.float64]] | None


def train(
    inputs: Inputs,
    config: Train,
    *,
    seed: int,
    threads: int,
    memory_mb: int | None = None,
    checkpoint_dir: Path,
    journal: Path | None = None,
    on_log: Callable[[str], None] | None = None,
    backend: Backend | None = None,
) -> TrainResult:
    """Optimise the first Gaussians until their renders look like the views.

    Goes on from the last checkpoint in ``checkpoint_dir`` if there is one of this very run; the
    caller deletes the folder when the result is safe.

    Args:
        threads: of the native operators; torch itself runs on one, so that sums are the same.
        memory_mb: that training may use: images that do not fit beside the Gaussians are read from
            a temporary file. None: three quarters of the machine's, or its container's, memory,
            which is the limit in any case. Changes no result.
        journal: file for how it goes, second by second (``training.loop.metrics_log``).
        on_log: called with one line for each warning, and for the instruction set, the compiler
            and the time a step takes.
        backend: of the rasterizer; None: the default.

    Raises:
        UserError: no views or no Gaussians, unreadable pictures, no view sees a Gaussian, the
            loss is not a number, or every Gaussian died.
    """
    if not inputs.views or not len(inputs.initial):
        raise UserError(
            f"expected views and Gaussians to train; found {len(inputs.views)} views and "
            f"{len(inputs.initial)} Gaussians",
            fix="check the split and the initialisation",
        )
    torch_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        backend = backend or make_backend()
        run = _Run(inputs, config, seed, threads, memory_mb, checkpoint_dir, on_log, backend)
        return run.train(journal)
    finally:
        torch.set_num_threads(torch_threads)


def shelf_for(views: Sequence[View], config: Train, limit_mb: int | None) -> Shelf:
    """Memory for the views' pixels where they fit beside the Gaussians, else a file."""
    pixels = sum(view.width * view.height for view in views)
    limit = min(machine_mb(), limit_mb or math.inf)
    fits = memory_mb(pixels, config.density.max_gaussians) <= limit
    return MemoryShelf() if fits else DiskShelf()


class _Run:
    """One call of ``train``: what does not change during it, and the state that does."""

    def __init__(
        self,
        inputs: Inputs,
        config: Train,
        seed: int,
        threads: int,
        memory_mb: int | None,
        checkpoint_dir: Path,
        on_log: Callable[[str], None] | None,
        backend: Backend,
    ):
        self.config, self.threads = config, threads
        self.backend = backend
        self.build = dict(backend.facts())
        self.checkpoint_dir, self.on_log = checkpoint_dir, on_log
        self.warnings: list[str] = []
        self.schedule = Schedule.of(config)
        minutes = config.budget_minutes
        self.pace = None if minutes is None else Pace(60 * minutes)
        self.near = near_plane(inputs.extent)
        self.cameras: dict[tuple[int, int], RasterCamera] = {}
        # auto is the plan's to settle; without one, nothing is known to be needed.
        self.depth_weight = 0.0 if config.depth_weight == "auto" else config.depth_weight
        if not self.depth_weight:
            inputs = replace(inputs, depths=None)
        self.identity = identity_of(inputs, config, seed)
        self.targets = Targets(
            inputs.views,
            threads,
            config.salt_and_pepper,
            seed,
            shelf_for(inputs.views, config, memory_mb),
        )
        self.inputs = self.without_hidden_views(inputs)
        gains = self.inputs.gains
        self.gains = None if gains is None else torch.from_numpy(gains.astype(np.float32))
        self.background = config.background
        if self.background == "auto":
            self.background = "white" if self.targets.have_alpha else "black"

        gaussians = inputs.initial.with_sh_degree(0).clone()
        rng = np.random.Generator(np.random.PCG64(seed))
        budget = config.density.max_gaussians
        if len(gaussians) > budget:
            self.warn(
                f"{len(gaussians)} Gaussians at the start are more than the budget: a random "
                f"{budget} of them are kept (train.density.max_gaussians)"
            )
            chosen = np.sort(rng.permutation(len(gaussians))[:budget])
            gaussians = gaussians.select(torch.from_numpy(chosen))
        gaussians = in_morton_order(gaussians)
        how = config.density
        if config.isotropic:  # a sphere has no longest axis
            how = how.model_copy(update={"split_kind": "sampled"})
        density = make_strategy(how, inputs.size)
        density.start(len(gaussians))
        cameras = MovingCameras.of(self.views, gaussians, inputs.extent, config)
        order = rng.permutation(len(self.views))
        adam = Adam(gaussians, config.adam_beta1, self.own_frames, self.backend)
        self.state = TrainState(gaussians, adam, density, cameras, rng, order)

    @property
    def views(self) -> Sequence[View]:
        return self.inputs.views

    def without_hidden_views(self, inputs: Inputs) -> Inputs:
        """A view that its mask hides asks for nothing, and would only feed Adam zeros."""
        hidden = self.targets.hidden()
        if len(hidden) == len(inputs.views):
            raise UserError("the masks leave no pixel of any view to train on", fix="check masks/")
        if not hidden:
            return inputs
        names = ", ".join(inputs.views[i].name for i in hidden[:5])
        self.warn(f"views that their masks hide whole are left out ({len(hidden)}): {names}")
        self.targets.drop(hidden)
        return inputs.without(hidden)

    def warn(self, message: str) -> None:
        self.warnings.append(message)
        self.log(message)

    def log(self, message: str) -> None:
        if self.on_log is not None:
            self.on_log(message)

    def train(self, journal_file: Path | None) -> TrainResult:
        state, steps = self.state, self.schedule.steps
        # What happened to checkpoints is told, but is no part of the result.
        found = checkpoint.load_latest(self.checkpoint_dir, self.identity, self.log)
        if found is not None:
            if text := other_build(found.values, self.build):
                self.log(text)
            state.restore(found.step, found.arrays, found.values)
        started = saved = time.monotonic()
        seconds_before = state.seconds
        progress = Progress("training", steps, unit="steps" if self.pace is None else "parts")
        progress.start_at(state.clock)
        journal = Journal(journal_file, state.step)
        records = max(1, steps // CURVE_RECORDS)
        timer = StepTimer(self.build, self.threads, steps - state.clock)
        while state.clock < steps:
            before = state.clock
            self.step()
            now = time.monotonic()
            state.seconds = seconds_before + now - started
            if text := timer.passes(state.seconds, self.factor()):
                self.log(text)
            if state.clock // records > before // records or state.clock == steps:
                self.record()
            if now - saved >= CHECKPOINT_SECONDS and state.clock < steps:
                self.save()
                saved = time.monotonic()
            progress.advance(state.clock - before, note=self.note())
            journal.write(state, steps, self.factor(), progress.seconds_left())
        return self.result()

    def advance(self) -> range:
        """Begin a step; the places in the schedule that it passes."""
        state = self.state
        state.step += 1
        before, state.clock = state.clock, state.step
        if self.pace is not None:
            steps = self.schedule.steps
            passed = int(steps * state.seconds / self.pace.budget)
            state.clock = max(1, before, min(steps, passed))
            self.pace.passes(state.step - 1, state.seconds, self.factor())
        return range(before + 1, state.clock + 1)

    def step(self) -> None:
        """One view: render, compare, differentiate, move; then density control when due."""
        state, config = self.state, self.config
        places, step = self.advance(), state.step
        self.raise_sh_degree()
        index = state.next_view()
        factor = self.factor()
        target, camera = self.targets.get(index, factor), self.camera(index, factor)
        background = self.draw_background()
        options = RasterOptions(
            sh_degree=state.gaussians.sh_degree,
            background=background,
            antialias=config.antialias,
            near=self.near,
            clamp_color_gradient=config.black_stays,
            gradients_per_pixel=config.gradients_per_pixel,
            threads=self.threads,
        )
        rendered = self.backend.forward(*state.gaussians.parameters(), camera, options)
        wanted = target.over(background)
        gain = None if self.gains is None else self.gains[index]
        seen = rendered.color if gain is None else rendered.color * gain
        loss = self.backend.l1_ssim(
            seen, wanted, config.ssim_weight, target.ignored, config.square_weight, self.threads
        )
        self.check(float(loss.loss), rendered.num_visible, rendered.num_dropped, index)
        d_color = loss.grad if gain is None else loss.grad * gain
        rates = self.rates()
        gradients = self.backend.backward(
            rendered,
            d_color,
            *self.further_gradients(rendered, target, index),
            means2d_abs=config.density.absolute_gradient,
            camera=state.cameras.move,
            sh_adam=state.adam.harmonics(rates, step),
        )
        if gradients.camera is not None:
            state.cameras.step(index, camera, gradients.camera, config, self.camera_share)
        state.density.observe(rendered, gradients, camera.width, camera.height)
        if config.isotropic:
            gradients.log_scales[:] = gradients.log_scales.mean(1, keepdim=True)
        state.density.regularise(state.gaussians, gradients)
        state.adam.step(state.gaussians, gradients, rates, step, self.threads)
        if state.clock <= self.schedule.refine_stop:
            left = self.schedule.lr_means_left_at(state.clock)
            pace = left * self.schedule.lr_boost_of(self.run_length())
            state.density.explore(state.gaussians, pace, state.rng)

        state.window.loss += float(loss.loss)
        state.window.steps += 1
        if (step - 1) % min(PSNR_EVERY, max(1, self.schedule.steps // CURVE_RECORDS)) == 0:
            state.window.psnr += target.psnr(seen, wanted)
            state.window.samples += 1
        self.control_density(places)

    def further_gradients(
        self, rendered: Forward, target: Target, index: int
    ) -> tuple[Tensor | None, Tensor | None]:
        """(d_alpha, d_depth) of what is asked for beside colours: the photograph's alpha, emptiness
        where a mask hides it, and in some steps the known depths."""
        asked = target.alpha_gradient(rendered.alpha, self.config)
        known = None if self.inputs.depths is None else self.inputs.depths[index]
        if not known or self.state.step % DEPTH_EVERY:
            return asked, None
        weight = self.depth_weight * DEPTH_EVERY
        d_alpha, d_depth = depth_gradients(rendered, known, self.views[index], weight)
        return d_alpha if asked is None else d_alpha + asked, d_depth

    def control_density(self, places: range) -> None:
        """Do what is due at these places of the schedule."""
        state, schedule = self.state, self.schedule
        densify = any(map(schedule.refines_after, places))
        clear = any(map(schedule.clears_air_after, places)) and self.clear_air()
        if densify or clear or any(map(schedule.prunes_after, places)):
            state.gaussians, changes = state.density.refine(
                state.gaussians,
                state.adam,
                state.rng,
                densify=densify,
                prune_huge=any(map(schedule.prunes_huge_after, places)),
                budget=self.budget(),
            )
            state.counters.changes.add(changes)
            state.reorder()
            if not len(state.gaussians):
                raise UserError(
                    f"every Gaussian has died by step {state.step}: none was of any use to the "
                    "pictures",
                    fix="check the poses and the masks; a lower train.density.prune_opacity or "
                    "init.method: points may help",
                )
        if any(map(schedule.resets_opacity_after, places)):
            state.density.reset_opacity(state.gaussians, state.adam)
            state.counters.opacity_resets += 1
        state.counters.max_gaussians = max(state.counters.max_gaussians, len(state.gaussians))

    def clear_air(self) -> bool:
        """Make floaters too faint for density control to keep; whether there are any."""
        state, air = self.state, self.inputs.air
        short = self.run_length() < CLEAR_AIR_LOOKS * len(self.views)
        if air is None or short or not self.config.density.clear_air:
            return False
        factor = usable_factor(self.views, CLEAR_AIR_FACTOR)
        cameras = [self.camera(index, factor) for index in range(len(self.views))]
        options = RasterOptions(
            antialias=self.config.antialias, near=self.near, threads=self.threads
        )
        found = fade_floaters(
            state.gaussians, cameras, air, options, pixel=factor**2, backend=self.backend
        )
        state.counters.floaters += found
        return found > 0

    def raise_sh_degree(self) -> None:
        """Bands that are not in use yet are not there at all: they would only cost time."""
        state = self.state
        degree = self.schedule.sh_degree_at(state.clock)
        if degree > state.gaussians.sh_degree:
            state.gaussians = state.gaussians.with_sh_degree(degree)
            state.adam.resize_bands(degree)

    def factor(self) -> int:
        """What pictures are reduced by in this step."""
        return usable_factor(self.views, self.schedule.resolution_factor(self.state.clock))

    def draw_background(self) -> Colour:
        if self.background == "random":
            red, green, blue = self.state.rng.random(3, np.float32).tolist()
            return red, green, blue
        return BACKGROUNDS[self.background]

    def rates(self) -> Rates:
        config, schedule, state = self.config, self.schedule, self.state
        boost = schedule.lr_boost_of(self.run_length())
        factor = boost * schedule.lr_decay_at(state.clock)
        unit = 1.0 if self.own_frames else self.inputs.size
        return Rates(
            means=schedule.lr_means_at(state.clock) * boost * unit,
            log_scales=config.lr_scales * factor,
            quats=config.lr_quats * factor,
            opacity_logits=config.lr_opacities * factor,
            sh0=config.lr_sh0 * factor,
            shN=config.lr_shN * factor,
        )

    @property
    def own_frames(self) -> bool:
        return self.config.lr_means_unit == "size"

    def run_length(self) -> float:
        """Steps in all, for rates; where the run has minutes: if they went on as until now. Those
        at small sizes are many, so that rates begin low: fox, views kept back, in one minute
        34.5 dB, and 33.9 with ``Pace.steps``, which foresees that full ones are fewer."""
        state, steps = self.state, self.schedule.steps
        return steps if self.pace is None else state.step * steps / state.clock

    def budget(self) -> int:
        """Most Gaussians now; where the run has minutes, no more than its steps can train."""
        limit = self.schedule.budget_at(self.state.clock)
        if self.pace is None:
            return limit
        steps = self.pace.steps(self.state.step, self.state.seconds, self.run_length())
        return min(limit, round(GAUSSIANS_A_STEP * steps))

    def camera(self, index: int, factor: int) -> RasterCamera:
        if (index, factor) not in self.cameras:
            self.cameras[index, factor] = raster_camera(self.views[index], factor)
        return self.state.cameras.camera(self.cameras[index, factor], index)

    def camera_share(self, looks: float) -> float:
        """What is due in this step of all that a camera may move, if this share of the steps looks
        at it."""
        run = max(1.0, self.run_length() * looks)
        return self.schedule.camera_step_at(self.state.clock, run)

    def check(self, loss: float, num_visible: int, num_dropped: int, index: int) -> None:
        """Stop where going on makes no sense; count what is odd."""
        counters, step = self.state.counters, self.state.step
        counters.num_dropped += num_dropped
        counters.blind_steps += num_visible == 0
        if not math.isfinite(loss):
            raise UserError(
                f"the loss is not a number at step {step}, view {self.views[index].name}",
                fix="lower the learning rates (train.lr_*), or check the poses and points",
            )
        if step >= len(self.views) and counters.blind_steps == step:
            raise UserError(
                f"no camera sees any Gaussian ({len(self.views)} views tried)",
                fix="check that the poses and the points are of one world and that the poses are "
                "world to camera, x right, y down, z forward",
            )

    def record(self) -> None:
        """Add to the curve and begin a new window."""
        state = self.state
        window = state.window
        previous = state.curve[-1]["psnr"] if state.curve else 0.0
        state.curve.append(
            {
                "step": state.step,
                "loss": window.loss / max(1, window.steps),
                "psnr": window.psnr / window.samples if window.samples else previous,
                "num_gaussians": len(state.gaussians),
            }
        )
        state.curve_seconds.append(state.seconds)
        state.window = Window()

    def note(self) -> str:
        text = f"{len(self.state.gaussians)} Gaussians"
        if self.state.curve:
            last = self.state.curve[-1]
            text = f"loss {last['loss']:.4f}, PSNR {last['psnr']:.2f} dB, {text}"
        return text

    def save(self) -> None:
        state = self.state
        values = state.values() | {"built": self.build}
        checkpoint.save(
            self.checkpoint_dir,
            Checkpoint(state.step, self.identity, state.arrays(), values),
        )

    def result(self) -> TrainResult:
        state, lenses = self.state, self.state.cameras.lenses
        if not self.config.gradients_per_pixel:  # there much that is seen has no gradient
            state.drop_unseen(len(self.views))
        if state.counters.blind_steps:
            self.warn(f"in {state.counters.blind_steps} steps the view saw no Gaussian")
        return TrainResult(
            gaussians=state.gaussians.with_sh_degree(self.config.sh_degree),
            curve=state.curve,
            curve_seconds=state.curve_seconds,
            counters=asdict(state.counters),
            near=self.near,
            background=self.background,
            warnings=self.warnings,
            steps=state.step,
            seconds=state.seconds,
            poses=self.poses_by_name(),
            lenses=None if lenses is None else lenses.by_id(),
        )

    def poses_by_name(self) -> dict[str, NDArray[np.float64]] | None:
        poses = self.state.cameras.poses
        if poses is None:
            return None
        return dict(zip([view.name for view in self.views], poses.poses, strict=True))
