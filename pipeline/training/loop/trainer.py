"""The optimisation of Gaussians, step by step: 3D Gaussian splatting (Kerbl et al. 2023)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.config.settled import TrainOptions
from pipeline.render import BACKGROUNDS, Backend, Color, RasterCamera, RasterOptions
from pipeline.runtime.errors import UserError
from pipeline.runtime.memory import release_free_memory
from pipeline.splats.gaussians import Gaussians
from pipeline.training.appearance.embedding import with_appearance
from pipeline.training.data.inputs import Inputs
from pipeline.training.data.step_view import StepView
from pipeline.training.data.targets import psnr_of, usable_factor
from pipeline.training.density.floaters import FADED_LOGIT, IMAGE_FACTOR, FloaterRemoval
from pipeline.training.density.reduced_views import ReducedViews
from pipeline.training.density.strategy import DensityStep
from pipeline.training.few_views import EarlyFit, central_view
from pipeline.training.loop.clock import Clock
from pipeline.training.loop.device_step import DeviceStep
from pipeline.training.loop.operator_step import OperatorStep
from pipeline.training.loop.schedule import Schedule, warm_up
from pipeline.training.loop.setup import TrainingScene
from pipeline.training.loop.state import TrainState
from pipeline.training.loop.step import Step, StepEngine, StepResult
from pipeline.training.optimisers.adam import AdamStep
from pipeline.training.run import TrainingRun
from pipeline.training.transients.evidence import ReducedPhotographs
from pipeline.training.transients.search import reduction


class Trainer:
    """Runs the optimisation. ``training.loop.train.train`` calls ``step`` until the schedule ends,
    then ``finish`` once; both change ``state``."""

    def __init__(
        self, scene: TrainingScene, state: TrainState, run: TrainingRun, backend: Backend
    ) -> None:
        self.scene, self.state, self.run, self.backend = scene, state, run, backend
        views = None if run.is_part else len(scene.views)
        self.schedule = Schedule.of(run.options, scene.inputs.seen_share, views)
        held_back = self.schedule.held_back_steps > 0
        self.held_back = central_view(scene.views) if held_back else None
        self.engine = make_engine(scene, state, run, backend, self.schedule)
        self.floaters = floater_removal(scene, run)
        self.rate_unit = learning_rate_unit(scene.inputs, run.options)
        self.clock = Clock(run.steps, run.options.budget_minutes, run.span)

    def step(self) -> None:
        """Render a view, compare it with its photograph, update the parameters, and densify or
        prune if due."""
        state = self.state
        # The steps of the schedule that this optimiser step covers: one, without a time budget.
        steps = self.clock.advance(state)
        self.raise_sh_degree()
        if self.held_back is not None and not self.holds_back() and state.early_fit is None:
            state.early_fit = self.measure_fit(self.held_back)
        self.clock.observe(state, self.factor())
        run_length = self.clock.run_length(state)
        view = self.next_view()
        rates = self.schedule.learning_rates(
            state.clock, run_length, self.rate_unit, warm_up(self.run.span, state.step)
        )
        results = self.engine.step(
            Step(
                view,
                self.raster_options(view.background),
                AdamStep(state.step, rates, view.camera.width * view.camera.height),
                camera_rate=lambda share: self.schedule.camera_rate(
                    state.clock, max(1.0, run_length * share)
                ),
                dropped_share=self.dropped_share(),
            )
        )
        self.count(results)
        self.control_density(steps, run_length)
        state.counters.max_gaussians = max(state.counters.max_gaussians, len(state.gaussians))

    def finish(self) -> None:
        """Remove the Gaussians that had no gradient in the last epoch, and those on the path
        between cameras that hide the scene from there."""
        self.fetch()
        self.backend.release_memory()
        state = self.state
        state.drop_unseen(len(self.scene.views), self.scene.sky)
        if self.floaters is not None:
            before, views = len(state.gaussians), self.reduced_views()
            state.gaussians = self.floaters.without_blockers(state.gaussians, views)
            state.counters.floaters += before - len(state.gaussians)

    def settle(self) -> None:
        """Wait for the results of all steps, before the figures of ``state`` are read."""
        self.count(self.engine.results())

    def fetch(self) -> None:
        """Make ``state`` current, before it is read."""
        self.settle()
        self.engine.fetch()

    def invalidate(self) -> None:
        """Make ``state`` current, before its tensors are changed."""
        self.settle()
        self.engine.invalidate()

    def next_view(self) -> StepView:
        """The view of this step: each view once in each shuffled epoch, but for that held back."""
        index = self.state.next_view()
        while index == self.held_back and self.holds_back():
            index = self.state.next_view()
        return self.step_view(index, self.draw_background())

    def step_view(self, index: int, background: Color) -> StepView:
        """A training view at the size of this step."""
        factor, transients = self.factor(), self.state.transients
        target = self.scene.target(index, factor)
        return StepView(
            index,
            factor,
            self.scene.views[index],
            target if transients is None else transients.applied(target, index),
            self.camera(index, factor),
            background,
        )

    def holds_back(self) -> bool:
        """Whether a view is held back in this step."""
        return self.state.clock <= self.schedule.held_back_steps

    def dropped_share(self) -> float:
        """The share of the Gaussians that is not drawn in this step."""
        fit = self.state.early_fit
        if self.held_back is not None and (fit is None or fit.is_exact):
            return 0.0
        return self.schedule.dropped_share_at(self.state.clock)

    def measure_fit(self, held_back: int) -> EarlyFit:
        """Compare the view held back with the other training views."""
        assert isinstance(self.engine, OperatorStep)
        background = BACKGROUNDS["black"]
        options, found = self.raster_options(background), []
        for index in range(len(self.scene.views)):
            found.append(self.engine.psnr(self.step_view(index, background), options))
        psnr = found.pop(held_back)
        return EarlyFit(psnr, psnr_of(float(np.mean([10 ** (-p / 10) for p in found]))))

    def control_density(self, steps: range, run_length: float) -> None:
        """Add noise, densify, prune and reset opacities after these steps of the schedule."""
        state, schedule = self.state, self.schedule
        floaters_due = self.floaters is not None and self.floaters.is_due(steps, run_length)
        transients_due = state.transients is not None and state.transients.is_due(steps, run_length)
        if not floaters_due and not transients_due and not state.density.is_due(steps):
            return
        self.invalidate()
        faded = self.fade_ghosts() if transients_due else 0
        faded += self.fade_floaters() if floaters_due else 0
        if self.run.is_part:
            self.backend.release_memory()  # The arrays of all Gaussians are copied.
        rate = schedule.means_decay_at(state.clock) * schedule.learning_rate_factor(run_length)
        limit = schedule.budget_at(state.clock)
        budget = self.clock.budget(state, limit)
        changed = state.apply(
            state.density.after_step(
                DensityStep(
                    state.gaussians,
                    state.adam,
                    state.rng,
                    steps,
                    noise_rate=rate,
                    budget=budget,
                    prune=faded > 0,
                    threads=self.run.threads,
                )
            )
        )
        if changed:
            release_free_memory()
            if not len(state.gaussians):
                raise UserError(
                    f"no Gaussian is left at step {state.step}: all became transparent",
                    fix="check the poses and the masks; init.method: points may help",
                )

    def fade_floaters(self) -> int:
        """Make floaters transparent, and return their number."""
        assert self.floaters is not None
        views = self.reduced_views()
        found = self.floaters.fade(self.state.gaussians, views)
        self.state.counters.floaters += found
        return found

    def fade_ghosts(self) -> int:
        """Search for transients, make the Gaussians that explain them transparent, and return their
        number."""
        state = self.state
        assert state.transients is not None
        ghosts = state.transients.search(self.reduced_photographs())
        state.gaussians.opacity_logits[ghosts] = FADED_LOGIT
        found = int(ghosts.sum())
        state.counters.ghosts += found
        return found

    def raise_sh_degree(self) -> None:
        """Allocate the coefficients of higher degrees when they come into use."""
        degree = self.schedule.sh_degree_at(self.state.clock)
        if degree > self.state.gaussians.sh_degree:
            self.invalidate()
            self.state.gaussians = self.state.gaussians.with_sh_degree(degree)
            self.state.adam.resize_bands(degree)

    def factor(self) -> int:
        """Factor by which images are reduced in this step."""
        return usable_factor(self.scene.views, self.schedule.resolution_factor(self.state.clock))

    def camera(self, index: int, factor: int) -> RasterCamera:
        """The refined camera of a view at 1 / ``factor`` of its size."""
        return self.state.cameras.camera(self.scene.camera(index, factor), index)

    def reduced_views(self) -> ReducedViews:
        factor = usable_factor(self.scene.views, IMAGE_FACTOR)
        return ReducedViews(
            [self.camera(index, factor) for index in range(len(self.scene.views))],
            RasterOptions(
                sh_degree=0,
                antialias=self.run.options.antialias,
                near=self.scene.near,
                threads=self.run.threads,
            ),
            pixel=factor**2,
            backend=self.backend,
        )

    def reduced_photographs(self) -> ReducedPhotographs:
        state, scene, factor = self.state, self.scene, reduction(self.scene.views)

        def shown(index: int) -> Gaussians:
            if state.appearance is None:
                return state.gaussians
            return with_appearance(state.gaussians, state.appearance.embeddings[index])

        return ReducedPhotographs(
            [self.camera(index, factor) for index in range(len(scene.views))],
            lambda index: scene.targets.reduced(index, factor),
            shown,
            lambda index: scene.inputs.light_factor(index, factor),
            self.raster_options(BACKGROUNDS.get(scene.background, BACKGROUNDS["black"])),
            self.backend,
        )

    def raster_options(self, background: Color) -> RasterOptions:
        return RasterOptions(
            sh_degree=self.state.gaussians.sh_degree,
            background=background,
            antialias=self.run.options.antialias,
            near=self.scene.near,
            clamp_color_gradient=self.run.options.experiments.clamp_color_gradient,
            threads=self.run.threads,
        )

    def draw_background(self) -> Color:
        if self.scene.inputs.open_layers is not None:
            return BACKGROUNDS["black"]  # The background is in the layer behind the block.
        if self.scene.background == "random":
            red, green, blue = self.state.rng.random(3, np.float32).tolist()
            return red, green, blue
        return BACKGROUNDS[self.scene.background]

    def count(self, results: Sequence[StepResult]) -> None:
        """Add steps to the counters and the curve; stop if no view sees a Gaussian."""
        state, counters, views = self.state, self.state.counters, self.scene.views
        for result in results:
            state.add_to_window(result.loss, result.psnr)
            counters.num_dropped += result.num_dropped
            counters.blind_steps += result.num_visible == 0
            if result.number >= len(views) and counters.blind_steps == result.number:
                raise UserError(
                    f"no camera sees any Gaussian ({len(views)} views tried)",
                    fix="check that the poses and the points have the same frame and that the "
                    "poses are world to camera, x right, y down, z forward",
                )


def make_engine(
    scene: TrainingScene,
    state: TrainState,
    run: TrainingRun,
    backend: Backend,
    schedule: Schedule,
) -> StepEngine:
    """Steps on the backend's device, or by its operators if that is the CPU or if the strategy
    needs more in a step than devices do: losses of its own, noise, drop-out, or light that varies
    over the image."""
    light = scene.inputs.light or ()
    uniform = all(of.is_uniform for of in light)
    operators = state.density.statistics is None or schedule.dropout > 0 or not uniform
    training = None if operators else backend.resident()
    if training is None:
        return OperatorStep(scene, state, run, backend)
    return DeviceStep(scene, state, run, backend, training)


def floater_removal(scene: TrainingScene, run: TrainingRun) -> FloaterRemoval | None:
    depths = scene.inputs.empty_depths
    if depths is None or not getattr(run.options.density, "remove_floaters", False):
        return None
    return FloaterRemoval(depths, run.steps)


def learning_rate_unit(inputs: Inputs, options: TrainOptions) -> float:
    """Unit of the means' learning rate, world units; 1 for each Gaussian's own scales."""
    match options.experiments.means_learning_rate_unit:
        case "gaussian_scale":
            return 1.0
        case "scene_scale":
            return inputs.size
        case "camera_extent":
            return inputs.extent
