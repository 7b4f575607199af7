"""The optimisation of Gaussians, step by step: 3D Gaussian splatting (Kerbl et al. 2023)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipeline.config.experiments import TrainExperiments
from pipeline.config.schema import Train
from pipeline.render import (
    BACKGROUNDS,
    Backend,
    Color,
    Forward,
    Gradients,
    RasterCamera,
    RasterOptions,
)
from pipeline.render.resident import Planes, ResidentImage, ResidentStep, StepResult
from pipeline.runtime.errors import UserError
from pipeline.runtime.memory import release_free_memory
from pipeline.training.appearance.embedding import AppearanceEmbeddings
from pipeline.training.data.known_depths import KnownDepths
from pipeline.training.data.targets import Target, psnr_of, usable_factor
from pipeline.training.density.camera_path import on_camera_path
from pipeline.training.density.floaters import IMAGE_FACTOR, FloaterRemoval
from pipeline.training.loop.clock import Clock
from pipeline.training.loop.resident import DeviceSteps
from pipeline.training.loop.schedule import Schedule, warm_up
from pipeline.training.loop.setup import TrainingScene, learning_rate_unit
from pipeline.training.loop.state import CURVE_RECORDS, TrainState
from pipeline.training.losses.alpha import BLOCK_ALPHA_LOSS, alpha_gradient
from pipeline.training.losses.depth import depth_gradients
from pipeline.training.optimisers.adam import AdamStep

# PSNR is computed in some of the steps only: it takes a pass over the image.
PSNR_INTERVAL = 10
# The depth loss is computed in some of the steps only, with a weight as if in all: rendering depths
# and their gradients takes half the time of a step.
DEPTH_INTERVAL = 4


@dataclass(frozen=True)
class StepView:
    """The view of a step, at 1 / ``factor`` of its size."""

    index: int
    factor: int
    target: Target
    camera: RasterCamera
    background: Color


class Trainer:
    """The steps of the optimisation; ``step`` changes ``state``."""

    def __init__(
        self,
        scene: TrainingScene,
        state: TrainState,
        config: Train,
        experiments: TrainExperiments,
        backend: Backend,
        threads: int,
        part: range,
    ):
        self.scene, self.state, self.backend, self.threads = scene, state, backend, threads
        self.config, self.experiments = config, experiments
        self.schedule = Schedule.of(config, experiments, scene.inputs.seen_share)
        self.part, self.clock = part, Clock(self.schedule.steps, config.budget_minutes, part)
        # A scene is divided where memory is short.
        self.saves_memory = len(part) < self.schedule.steps
        self.rate_unit = learning_rate_unit(scene.inputs, experiments)
        self.psnr_interval = min(PSNR_INTERVAL, max(1, self.schedule.steps // CURVE_RECORDS))
        depths = scene.inputs.empty_depths
        self.device = DeviceSteps.of(backend, state, isotropic=experiments.isotropic)
        if self.device is not None:
            state.fetch = self.device.fetch
        self.floaters = None
        if depths is not None and getattr(config.density, "remove_floaters", False):
            self.floaters = FloaterRemoval(depths, self.schedule.steps)

    def step(self) -> None:
        """Render a view, compare it with its photograph, update the parameters, and densify or
        prune if due."""
        state = self.state
        steps = self.clock.advance(state)
        self.clock.observe(state, self.factor())
        self.raise_sh_degree()
        index, factor = state.next_view(), self.factor()
        view = StepView(
            index,
            factor,
            self.scene.target(index, factor),
            self.camera(index, factor),
            self.draw_background(),
        )
        run_length = self.clock.run_length(state)
        rates = self.schedule.learning_rates(
            state.clock, run_length, self.rate_unit, warm_up(self.part, state.step)
        )
        adam_step = AdamStep(state.step, rates, view.camera.width * view.camera.height)
        if self.device is not None:
            self.step_on_device(self.device, view, adam_step)
        else:
            self.step_by_operators(view, adam_step)
        self.control_density(steps, run_length)
        state.counters.max_gaussians = max(state.counters.max_gaussians, len(state.gaussians))

    def step_by_operators(self, view: StepView, adam_step: AdamStep) -> None:
        """Render, differentiate and update by the backend's operators."""
        state, index = self.state, view.index
        appearance = state.appearance
        colours = None if appearance is None else appearance.show(state.gaussians, index)
        rendered = self.backend.forward(
            *state.gaussians.parameters(), view.camera, self.options(view.background)
        )
        d_color, d_alpha = self.color_loss(rendered, view)
        by_alpha, d_depth = self.other_losses(rendered, view)
        gradients = self.backend.backward(
            rendered,
            d_color,
            _sum(d_alpha, by_alpha),
            d_depth,
            means2d_abs=state.density.needs_absolute_gradients,
            colors=appearance is not None,
            camera=state.cameras.enabled,
            sh_adam=state.adam.harmonics(adam_step),
        )
        if appearance is not None and colours is not None:
            appearance.hide(state.gaussians, colours)
            self.step_appearance(appearance, index, gradients, adam_step)
        if gradients.camera is not None:
            state.cameras.step(index, view.camera, gradients.camera, self.camera_rate)
        if self.experiments.isotropic:
            gradients.log_scales[:] = gradients.log_scales.mean(1, keepdim=True)
        state.density.before_step(state.gaussians, rendered, gradients)
        state.adam.step(state.gaussians, gradients, adam_step, self.threads)

    def step_on_device(self, device: DeviceSteps, view: StepView, adam_step: AdamStep) -> None:
        """The same in the memory of a device."""
        state, index, target = self.state, view.index, view.target
        appearance = state.appearance
        fixed = target.alpha is None or self.scene.background != "random"
        gain = None if self.scene.gains is None else self.scene.gains[index].tolist()
        red, green, blue = gain or (1.0, 1.0, 1.0)
        image = ResidentImage(
            key=(index, view.factor) if fixed else None,
            target=target.over(view.background),
            mask=target.ignored,
            gain=(red, green, blue),
            surroundings=target.surroundings,
        )

        def losses(planes: Planes) -> tuple[Tensor | None, Tensor | None]:
            return self.other_losses(planes, view)

        result = device.step(
            ResidentStep(
                camera=view.camera,
                options=self.options(view.background),
                image=image,
                ssim_weight=self.config.ssim_loss_weight,
                l2_weight=self.experiments.squared_error_loss_weight,
                absolute=state.density.needs_absolute_gradients,
                camera_gradients=state.cameras.enabled,
                embedding=None if appearance is None else tuple(appearance.embeddings[index]),
                alpha_loss=BLOCK_ALPHA_LOSS,
                losses=losses if self.has_other_losses(view) else None,
                adam=state.adam.resident(adam_step),
            )
        )
        self.check(result.loss, result, index)
        self.add_to_window(result.loss, lambda: psnr_of(result.squared_error))
        if result.camera is not None:
            state.cameras.step(index, view.camera, result.camera, self.camera_rate)
        if appearance is not None and result.embedding is not None:
            appearance.update(index, np.array(result.embedding), self.embedding_rate())

    def leave_device(self) -> None:
        """Make the state's tensors current, before they are changed."""
        if self.device is not None:
            self.device.fetch()
            self.device.invalidate()

    def step_appearance(
        self,
        appearance: AppearanceEmbeddings,
        index: int,
        gradients: Gradients,
        adam_step: AdamStep,
    ) -> None:
        """Update the embedding of the view and the appearance of the Gaussians."""
        state = self.state
        assert gradients.colors is not None
        appearance.step(
            index,
            state.gaussians,
            gradients.colors,
            state.adam.appearance(adam_step),
            self.embedding_rate(),
            self.backend,
            self.threads,
        )

    def color_loss(self, rendered: Forward, view: StepView) -> tuple[Tensor, Tensor | None]:
        """Gradients of L1, squared error and D-SSIM with respect to the rendered colours and, for a
        block among its surroundings, alpha."""
        index, target, around = view.index, view.target, view.target.surroundings
        image = target.over(view.background)
        gain = None if self.scene.gains is None else self.scene.gains[index]
        color = rendered.color
        if around is not None:
            color = self.backend.compose(around, color, rendered.alpha, self.threads)
        if gain is not None:
            color = color * gain
        loss = self.backend.l1_ssim(
            color,
            image,
            self.config.ssim_loss_weight,
            target.ignored,
            self.experiments.squared_error_loss_weight,
            self.threads,
        )
        self.check(float(loss.loss), rendered, index)
        self.add_to_window(float(loss.loss), lambda: target.psnr(color, image))
        d_color = loss.grad if gain is None else loss.grad * gain
        if around is None:
            return d_color, None
        return self.backend.compose_backward(
            around, rendered.alpha, d_color, BLOCK_ALPHA_LOSS, self.threads
        )

    def add_to_window(self, loss: float, psnr: Callable[[], float]) -> None:
        """Add a step to the sums of the curve's next record."""
        window = self.state.window
        window.loss += loss
        window.steps += 1
        if (self.state.step - 1) % self.psnr_interval == 0:
            window.psnr += psnr()
            window.samples += 1

    def other_losses(self, rendered: Planes, view: StepView) -> tuple[Tensor | None, Tensor | None]:
        """Gradients of the other losses with respect to alpha and depth; None without these
        losses."""
        d_alpha = alpha_gradient(
            rendered.alpha,
            view.target,
            self.config.mask_loss_weight,
            self.experiments.alpha_loss_weight,
            self.experiments.squared_error_loss_weight,
        )
        weight, known = self.config.depth_loss_weight, self.depths_due(view.index)
        if known is None or weight == "auto":
            return d_alpha, None
        full = self.scene.views[view.index]
        by_depth, d_depth = depth_gradients(rendered, known, full, weight * DEPTH_INTERVAL)
        return _sum(by_depth, d_alpha), d_depth

    def has_other_losses(self, view: StepView) -> bool:
        """Whether ``other_losses`` may return gradients."""
        target = view.target
        masks = target.ignored is not None and self.config.mask_loss_weight > 0
        alpha = target.alpha is not None and self.experiments.alpha_loss_weight > 0
        return masks or alpha or self.depths_due(view.index) is not None

    def depths_due(self, index: int) -> KnownDepths | None:
        """The known depths of a view, if the depth loss is computed in this step."""
        depths, weight = self.scene.inputs.depths, self.config.depth_loss_weight
        known = None if depths is None else depths[index]
        if not known or weight == "auto" or self.state.step % DEPTH_INTERVAL:
            return None
        return known

    def control_density(self, steps: range, run_length: float) -> None:
        """Add noise, densify, prune and reset opacities after these steps of the schedule."""
        state, schedule = self.state, self.schedule
        if self.device is not None:
            if not self.floaters_due(steps, run_length) and not state.density.is_due(steps):
                return
            self.leave_device()
        floaters = self.fade_floaters(steps, run_length)
        if self.saves_memory and state.density.is_due(steps):
            self.backend.release_memory()  # The arrays of all Gaussians are copied.
        rate = schedule.means_decay_at(state.clock) * schedule.learning_rate_factor(run_length)
        update = state.density.after_step(
            state.gaussians,
            state.adam,
            state.rng,
            steps,
            rate=rate,
            budget=self.clock.budget(state, schedule.budget_at(state.clock)),
            prune=floaters > 0,
        )
        state.gaussians = update.gaussians
        changes, opacity_reset = update.changes, update.opacity_reset
        del update  # Or its Gaussians would be in memory beside those in another order.
        if changes is not None:
            state.counters.changes.add(changes)
            # Arrays of another size leave gaps.
            release_free_memory()
            state.reorder()
            release_free_memory()
            if not len(state.gaussians):
                raise UserError(
                    f"no Gaussian is left at step {state.step}: all became transparent",
                    fix="check the poses and the masks; init.method: points may help",
                )
        state.counters.opacity_resets += opacity_reset

    def fade_floaters(self, steps: range, run_length: float) -> int:
        """The number of floaters, made transparent if their removal is due."""
        if self.floaters is None or not self.floaters_due(steps, run_length):
            return 0
        cameras, factor = self.reduced_cameras()
        found = self.floaters.fade(
            self.state.gaussians,
            cameras,
            self.geometry_options(),
            pixel=factor**2,
            backend=self.backend,
        )
        self.state.counters.floaters += found
        return found

    def floaters_due(self, steps: range, run_length: float) -> bool:
        return self.floaters is not None and self.floaters.is_due(steps, run_length)

    def clear_camera_path(self) -> None:
        """At the end, remove the Gaussians that hide views from between the cameras."""
        if self.floaters is None:
            return
        found = on_camera_path(
            self.state.gaussians,
            self.reduced_cameras()[0],
            self.floaters.depths,
            self.geometry_options(),
            self.backend,
        )
        if not found.all():
            self.state.counters.floaters += int(found.sum())
            self.state.gaussians = self.state.gaussians.select(torch.nonzero(~found)[:, 0])

    def reduced_cameras(self) -> tuple[list[RasterCamera], int]:
        """The refined cameras of all views at a reduced size, and the factor of it."""
        factor = usable_factor(self.scene.views, IMAGE_FACTOR)
        return [self.camera(index, factor) for index in range(len(self.scene.views))], factor

    def geometry_options(self) -> RasterOptions:
        """Without colour and background."""
        return RasterOptions(
            sh_degree=0,
            antialias=self.config.antialias,
            near=self.scene.near,
            threads=self.threads,
        )

    def options(self, background: Color) -> RasterOptions:
        return RasterOptions(
            sh_degree=self.state.gaussians.sh_degree,
            background=background,
            antialias=self.config.antialias,
            near=self.scene.near,
            clamp_color_gradient=self.experiments.clamp_color_gradient,
            gradients_per_pixel=self.experiments.gradients_per_pixel,
            threads=self.threads,
        )

    def camera(self, index: int, factor: int) -> RasterCamera:
        """The refined camera of a view at 1 / ``factor`` of its size."""
        return self.state.cameras.camera(self.scene.camera(index, factor), index)

    def camera_rate(self, share: float) -> float:
        """Learning rate of a camera that this share of the steps uses (``Schedule``)."""
        updates = max(1.0, self.clock.run_length(self.state) * share)
        return self.schedule.camera_rate(self.state.clock, updates)

    def embedding_rate(self) -> float:
        """Learning rate of an appearance embedding, which one view uses."""
        return self.camera_rate(1 / len(self.scene.views))

    def factor(self) -> int:
        """Factor by which images are reduced in this step."""
        return usable_factor(self.scene.views, self.schedule.resolution_factor(self.state.clock))

    def raise_sh_degree(self) -> None:
        """Coefficients of higher degrees are allocated when they come into use."""
        degree = self.schedule.sh_degree_at(self.state.clock)
        if degree > self.state.gaussians.sh_degree:
            self.leave_device()
            self.state.gaussians = self.state.gaussians.with_sh_degree(degree)
            self.state.adam.resize_bands(degree)

    def draw_background(self) -> Color:
        if self.scene.inputs.open_layers is not None:
            return BACKGROUNDS["black"]  # The background is in the layer behind the block.
        if self.scene.background == "random":
            red, green, blue = self.state.rng.random(3, np.float32).tolist()
            return red, green, blue
        return BACKGROUNDS[self.scene.background]

    def check(self, loss: float, rendered: Forward | StepResult, index: int) -> None:
        """Stop if the loss is not finite or no view sees a Gaussian."""
        counters, step, views = self.state.counters, self.state.step, self.scene.views
        counters.num_dropped += rendered.num_dropped
        counters.blind_steps += rendered.num_visible == 0
        if not math.isfinite(loss):
            raise UserError(
                f"the loss is not finite at step {step}, view {views[index].name}",
                fix="lower experiments.train.learning_rate_factor, or check the poses and points",
            )
        if step >= len(views) and counters.blind_steps == step:
            raise UserError(
                f"no camera sees any Gaussian ({len(views)} views tried)",
                fix="check that the poses and the points have the same frame and that the poses "
                "are world to camera, x right, y down, z forward",
            )


def _sum(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    if first is None or second is None:
        return first if second is None else second
    return first + second
