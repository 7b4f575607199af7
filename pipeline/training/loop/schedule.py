"""Resolution, SH degree and learning rates by step.

Steps are counted from 1. A run with a time budget passes through the schedule of ``NOMINAL_STEPS``
steps by the share of its time (``loop.clock``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.config.settled import TrainOptions
from pipeline.training.density.timeline import schedule_length, shrunk
from pipeline.training.few_views import dropout_of, held_back_steps, sh_degree_of
from pipeline.training.optimisers.adam import Rates

COARSE_FACTORS = (4, 2)
# The shares of a run's steps and of its minutes at reduced resolution, and the most minutes. Coarse
# steps take a third or a ninth of the time of others.
COARSE_STEPS, COARSE_MINUTES, MAX_COARSE_MINUTES = 0.15, 0.1, 1.2
# The length of the papers' runs. Shorter runs have higher learning rates, by the root of the ratio
# (as for batch sizes), at most by MAX_FACTOR.
PAPER_STEPS = 30_000
MAX_FACTOR = 4.0
# The factor is at most MAX_FACTOR if a Gaussian is seen by this share of the views, and less in
# large scenes: Adam's second moment is a mean over all steps, so that the step of a Gaussian that
# is seen in a share p of them grows by 1 / sqrt(p).
USUAL_SEEN_SHARE = 0.5
# A part that begins in the middle of the schedule has no moments of Adam: in the first steps, each
# parameter would move by its whole learning rate. Rates rise over so many steps, at most over this
# share of the part.
WARM_UP_STEPS, WARM_UP_SHARE = 50, 0.2
# Learning rate of cameras in the last step over that in the first: as for the means in 3DGS.
CAMERA_DECAY = 0.01


def warm_up(part: range, step: int) -> float:
    """Factor of the learning rates in a step of a part, counted from 1."""
    steps = min(WARM_UP_STEPS, WARM_UP_SHARE * len(part)) if part.start else 0
    return min(1.0, step / steps) if steps else 1.0


@dataclass(frozen=True)
class Schedule:
    """The phases of one run.

    Attributes:
        options: The options of the run.
        steps: The number of steps.
        sh_interval: The number of steps between one SH degree and the next.
        coarse_steps: The number of steps at reduced resolution: the first half at 1/4, the others
            at 1/2.
        seen_share: The mean share of the views that see a Gaussian.
        sh_degree: The maximum degree of the spherical harmonics.
        dropout: The share of the Gaussians that is not drawn in the last step.
        held_back_steps: The number of steps in which one view is not used.
    """

    options: TrainOptions
    steps: int
    sh_interval: int
    coarse_steps: int
    seen_share: float
    sh_degree: int
    dropout: float
    held_back_steps: int

    @staticmethod
    def of(options: TrainOptions, seen_share: float = 1.0, views: int | None = None) -> Schedule:
        """The schedule of ``options.steps`` steps, or of ``options.budget_minutes``.

        Args:
            views: The number of training views; None for so many that none of this is limited.
        """
        minutes, experiments = options.budget_minutes, options.experiments
        steps = schedule_length(options)
        coarse = experiments.coarse_share
        if coarse is None:
            coarse = COARSE_STEPS
            if minutes is not None:
                coarse = min(COARSE_MINUTES, MAX_COARSE_MINUTES / minutes)
        return Schedule(
            options=options,
            steps=steps,
            sh_interval=max(1, shrunk(experiments.sh_degree_interval, steps)),
            coarse_steps=int(coarse * steps),
            seen_share=seen_share,
            sh_degree=options.sh_degree if views is None else sh_degree_of(options, views),
            dropout=0.0 if views is None else dropout_of(options, views),
            held_back_steps=0 if views is None else held_back_steps(options, views),
        )

    def resolution_factor(self, step: int) -> int:
        """4, 2 or 1: images of this step are reduced by this factor."""
        if step > self.coarse_steps:
            return 1
        return COARSE_FACTORS[(step - 1) * len(COARSE_FACTORS) // self.coarse_steps]

    def sh_degree_at(self, step: int) -> int:
        return min(self.sh_degree, step // self.sh_interval)

    def dropped_share_at(self, step: int) -> float:
        """The share of the Gaussians that is not drawn in a step: it rises linearly from 0."""
        return self.dropout * step / self.steps

    def budget_at(self, step: int) -> int:
        """Upper limit of the number of Gaussians: lower at reduced resolution, which has fewer
        pixels to fit."""
        return round(self.options.density.max_gaussians / math.sqrt(self.resolution_factor(step)))

    def learning_rates(
        self, step: int, run_length: float, unit: float, warm_up: float = 1.0
    ) -> Rates:
        """The learning rates of a step.

        Args:
            warm_up: The factor that multiplies all learning rates.
            run_length: The number of optimiser steps of the whole run, or its estimate.
            unit: The unit of the means' learning rate, world units; 1 for each Gaussian's own
                scales.
        """
        rates = self.options.experiments
        run_factor = self.learning_rate_factor(run_length) * warm_up
        factor = run_factor * self.decay_at(step)
        means = rates.means_learning_rate * self.means_decay_at(step)
        return Rates(
            means=means * run_factor * unit,
            log_scales=rates.scales_learning_rate * factor,
            quats=rates.quats_learning_rate * factor,
            opacity_logits=rates.opacities_learning_rate * factor,
            sh0=rates.sh0_learning_rate * factor,
            shN=rates.shN_learning_rate * factor,
        )

    def means_decay_at(self, step: int) -> float:
        """Learning rate of the means over its initial value: log-linear decay over the run."""
        initial = self.options.experiments.means_learning_rate
        if not initial:
            return 1.0
        t = (step - 1) / max(1, self.steps - 1)
        return float((self.options.experiments.means_final_learning_rate / initial) ** t)

    def decay_at(self, step: int) -> float:
        """The other learning rates over their initial values: 1, then log-linear decay."""
        begin = self.options.experiments.learning_rate_decay_start * self.steps
        t = max(0.0, step - begin) / max(1.0, self.steps - begin)
        return float(self.options.experiments.learning_rate_final_factor**t)

    def learning_rate_factor(self, run_length: float) -> float:
        """Factor of all learning rates in a run of so many optimiser steps."""
        factor = self.options.experiments.learning_rate_factor
        if factor is not None:
            return factor
        limit = MAX_FACTOR * math.sqrt(min(1.0, self.seen_share / USUAL_SEEN_SHARE))
        return min(max(1.0, limit), math.sqrt(max(1.0, PAPER_STEPS / run_length)))

    def camera_rate(self, step: int, updates: float) -> float:
        """Learning rate of a camera, as a share of the upper limit of its total change: log-linear
        decay to ``CAMERA_DECAY`` such that ``updates`` of them in the run sum to 1."""
        decay = math.log(CAMERA_DECAY)
        return float(math.exp(decay * step / self.steps) * decay / (CAMERA_DECAY - 1) / updates)
