"""A step by the operators of a backend, with all parameters in the memory of the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pipeline.render import (
    Backend,
    Forward,
    Gradients,
    ImageGradients,
    RasterOptions,
    ViewGradients,
)
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.step_view import StepView
from pipeline.training.few_views import ThinnedOpacities, thinned
from pipeline.training.loop.setup import TrainingScene
from pipeline.training.loop.state import TrainState
from pipeline.training.loop.step import Step, StepEngine, StepResult
from pipeline.training.losses.color import ColorLoss
from pipeline.training.losses.plane import add, summed_gradients
from pipeline.training.run import TrainingRun


class OperatorStep(StepEngine):
    """Renders, differentiates and updates, an operator at a time."""

    def __init__(
        self, scene: TrainingScene, state: TrainState, run: TrainingRun, backend: Backend
    ) -> None:
        super().__init__(scene, state, run, backend)
        self.color_loss = ColorLoss(
            run.options.ssim_loss_weight,
            run.options.experiments.squared_error_loss_weight,
            scene.inputs.light_factor,
            backend,
            run.threads,
        )

    def step(self, step: Step) -> Sequence[StepResult]:
        state, view = self.state, step.view
        gaussians, appearance = state.gaussians, state.appearance
        shown = None if appearance is None else appearance.show(gaussians, view.index)
        opacities = self._thinned(step)
        drawn = gaussians
        if opacities is not None:
            drawn = replace(gaussians, opacity_logits=opacities.logits)
        rendered = self.backend.forward(*drawn.parameters(), view.camera, step.options)
        color = self.color_loss.gradients(rendered, view)
        self.require_finite(color.loss, view, state.step)
        others = summed_gradients(self.losses, rendered, view, state.step)
        d_alpha = add(color.d_alpha, others.alpha)
        of_images = ImageGradients(color.d_color, d_alpha, others.depth)
        found = self._update(step, drawn, opacities, rendered, of_images)
        if appearance is not None and shown is not None:
            appearance.hide(gaussians, shown)
        self._update_photograph(step, found)
        return [
            StepResult(
                state.step, color.loss, color.psnr, rendered.num_visible, rendered.num_dropped
            )
        ]

    def _update(
        self,
        step: Step,
        drawn: Gaussians,
        opacities: ThinnedOpacities | None,
        rendered: Forward,
        of_images: ImageGradients,
    ) -> ViewGradients:
        """Update the Gaussians and the statistics of density control, at once if nothing else needs
        the gradients."""
        state, adam = self.state, self.state.adam.of_all(step.adam)
        colors, camera = state.appearance is not None, state.cameras.enabled
        if adam is not None and opacities is None and state.density.statistics is not None:
            return self.backend.update(
                rendered, drawn.parameters(), of_images, adam=adam,
                statistics=state.density.statistics, colors=colors, camera=camera,
            )  # fmt: skip
        gradients = self.backend.backward(
            rendered, *of_images, colors=colors, camera=camera,
            sh_adam=state.adam.harmonics(step.adam),
        )  # fmt: skip
        if opacities is not None:
            gradients.opacity_logits.mul_(opacities.derivative)
        self._observe(rendered, gradients)
        state.adam.step(state.gaussians, gradients, step.adam, self.run.threads)
        return ViewGradients(gradients.colors, gradients.camera)

    def _observe(self, rendered: Forward, gradients: Gradients) -> None:
        """Let density control observe the step."""
        density = self.state.density
        if density.statistics is None:
            density.before_step(self.state.gaussians, rendered, gradients)
        else:
            self.backend.observe_gradients(
                rendered, gradients, *density.statistics, self.run.threads
            )

    def results(self) -> Sequence[StepResult]:
        """There are none: ``step`` returns the result of each step."""
        return []

    def _thinned(self, step: Step) -> ThinnedOpacities | None:
        """The opacities of the step; None without drop-out."""
        if not step.dropped_share:
            return None
        return thinned(self.state.gaussians.opacity_logits, step.dropped_share, self.state.rng)

    def psnr(self, view: StepView, options: RasterOptions) -> float:
        """PSNR in dB of a view."""
        gaussians, appearance = self.state.gaussians, self.state.appearance
        shown = None if appearance is None else appearance.show(gaussians, view.index)
        rendered = self.backend.forward(*gaussians.parameters(), view.camera, options)
        if appearance is not None and shown is not None:
            appearance.hide(gaussians, shown)
        return self.color_loss.gradients(rendered, view).psnr

    def fetch(self) -> None:
        """The tensors of the state are always current."""

    def invalidate(self) -> None:
        """There are no copies of the tensors of the state."""

    def _update_photograph(self, step: Step, gradients: ViewGradients) -> None:
        """Update what belongs to the photograph: its camera and its appearance."""
        state, view = self.state, step.view
        if state.appearance is not None:
            assert gradients.colors is not None
            state.appearance.step(
                view.index,
                state.gaussians,
                gradients.colors,
                state.adam.moments("appearance"),
                state.adam.rates(step.adam)["appearance"],
                self.embedding_rate(step),
                self.backend,
                self.run.threads,
            )
        if gradients.camera is not None:
            state.cameras.step(view.index, view.camera, gradients.camera, step.camera_rate)
