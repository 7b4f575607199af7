"""What happens when: resolution, SH degree, learning rates and density control by step.

Intervals in the config mean what they say for runs of ``NOMINAL_STEPS`` and more. Shorter runs
have them all shrunk by ``steps / NOMINAL_STEPS``, so that 600 steps pass through the same phases
as 7000. Steps count from 1: "after step t".

A run that has minutes instead of steps goes through the schedule of ``NOMINAL_STEPS`` by the share
of its time that has passed: its clock, not its steps, counts here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.config.schema import Train

NOMINAL_STEPS = 7000
# Fewer steps than this between two densifications say too little about a gradient's mean.
MIN_REFINE_INTERVAL = 10
COARSE_FACTORS = (4, 2)
# Shares of a run. A coarse step costs a third of a full one, or a ninth, so 0.15 of the steps are
# 0.03 of the time; a time budget spends more on them, because more steps fit. Long runs need small
# pictures for no longer.
COARSE_STEPS, COARSE_MINUTES, MOST_COARSE_MINUTES = 0.15, 0.1, 1.2
# The papers' length of a run, for which the configured learning rates are right. The noise of one
# view a step asks that a run of fewer goes farther in each: by the root, as for batches. At 3000
# steps three times the rates were best and five times worse than three: four is the most.
PAPER_STEPS = 30_000
MAX_BOOST = 4.0
# Floaters go after these shares of a run: what early ones would grow into, others must explain.
CLEAR_AIR = 0.3, 0.5, 0.7, 0.9
# A camera's last step over its first: the means' rates fall as far.
POSE_FALL = 0.01


@dataclass(frozen=True)
class Schedule:
    """The phases of one run.

    Attributes:
        steps: optimiser steps in all.
        sh_degree, sh_interval: final SH degree; steps between one degree and the next.
        coarse_steps: steps at reduced resolution, first half of them at 1/4, the rest at 1/2.
        refine_start, refine_stop, refine_interval: density control after steps of this range.
        reset_interval: steps between opacity resets.
        max_gaussians: the budget.
        lr_means, lr_means_final: of the first and the last step.
        lr_boost: all rates are multiplied by this (None: see ``PAPER_STEPS``).
        lr_decay_from, lr_final_share: from this share of the run on, all other rates fall to this
            share of themselves.
    """

    steps: int
    sh_degree: int
    sh_interval: int
    coarse_steps: int
    refine_start: int
    refine_stop: int
    refine_interval: int
    reset_interval: int
    max_gaussians: int
    lr_means: float
    lr_means_final: float
    lr_boost: float | None
    lr_decay_from: float
    lr_final_share: float

    @staticmethod
    def of(config: Train) -> Schedule:
        """The schedule of ``config.steps`` steps, or of ``config.budget_minutes``."""
        steps = config.steps if config.budget_minutes is None else NOMINAL_STEPS
        coarse = config.coarse_until
        if coarse == "auto":
            coarse, minutes = COARSE_STEPS, config.budget_minutes
            if minutes is not None:
                coarse = min(COARSE_MINUTES, MOST_COARSE_MINUTES / minutes)
        shrink = min(1.0, steps / NOMINAL_STEPS)
        density = config.density
        interval = min(density.interval, MIN_REFINE_INTERVAL)
        return Schedule(
            steps=steps,
            sh_degree=config.sh_degree,
            sh_interval=max(1, round(config.sh_interval * shrink)),
            coarse_steps=int(coarse * steps),
            refine_start=round(density.start_step * shrink),
            refine_stop=round(density.stop_share * steps),
            refine_interval=max(interval, round(density.interval * shrink)),
            reset_interval=max(1, round(density.opacity_reset_interval * shrink)),
            max_gaussians=density.max_gaussians,
            lr_means=config.lr_means,
            lr_means_final=config.lr_means_final,
            lr_boost=None if config.lr_boost == "auto" else config.lr_boost,
            lr_decay_from=config.lr_decay_from,
            lr_final_share=config.lr_final_share,
        )

    def resolution_factor(self, step: int) -> int:
        """4, 2 or 1: images of step ``step`` are reduced by this."""
        if step > self.coarse_steps:
            return 1
        return COARSE_FACTORS[(step - 1) * len(COARSE_FACTORS) // self.coarse_steps]

    def sh_degree_at(self, step: int) -> int:
        return min(self.sh_degree, step // self.sh_interval)

    def lr_means_at(self, step: int) -> float:
        """Log-linear between the first and the last step."""
        return self.lr_means * self.lr_means_left_at(step)

    def lr_means_left_at(self, step: int) -> float:
        """What is left of the means' first rate."""
        if not self.lr_means:
            return 1.0
        t = (step - 1) / max(1, self.steps - 1)
        return float((self.lr_means_final / self.lr_means) ** t)

    def camera_step_at(self, step: int, looks: float) -> float:
        """How far a camera goes in a look, as a share of all that it can: falls log-linearly to
        ``POSE_FALL`` of the first, and sums to 1 over ``looks`` in a run."""
        fall = math.log(POSE_FALL)
        return float(math.exp(fall * step / self.steps) * fall / (POSE_FALL - 1) / looks)

    def lr_boost_of(self, run: float) -> float:
        """What all rates are multiplied by in a run of so many steps."""
        return self.lr_boost or min(MAX_BOOST, math.sqrt(max(1.0, PAPER_STEPS / run)))

    def lr_decay_at(self, step: int) -> float:
        """What all rates but the means' are multiplied by: 1, then falling log-linearly."""
        begin = self.lr_decay_from * self.steps
        t = max(0.0, step - begin) / max(1.0, self.steps - begin)
        return float(self.lr_final_share**t)

    def budget_at(self, step: int) -> int:
        """Most Gaussians after density control at this step: fewer while the pictures are coarse,
        where more would cost as much as at full size and have no pixels to learn from."""
        return round(self.max_gaussians / math.sqrt(self.resolution_factor(step)))

    def refines_after(self, step: int) -> bool:
        """Densify and prune after this step."""
        return self.refine_start <= step <= self.refine_stop and step % self.refine_interval == 0

    def prunes_after(self, step: int) -> bool:
        """Prune after this step (densification is over, but useless Gaussians still cost time);
        not in the last tenth, where nothing would make up for what is lost."""
        return self.refine_stop < step <= 0.9 * self.steps and step % self.refine_interval == 0

    def clears_air_after(self, step: int) -> bool:
        """Take floaters away; the last time with some left to mend what that leaves bare."""
        return step in [round(share * self.steps) for share in CLEAR_AIR]

    def resets_opacity_after(self, step: int) -> bool:
        """Only where a whole interval of density control follows to recover in."""
        return step % self.reset_interval == 0 and step + self.reset_interval <= self.refine_stop

    def prunes_huge_after(self, step: int) -> bool:
        """After the first opacity reset, as 3DGS: Gaussians that had to be large at first (a
        distant background) have been split by then. Runs too short for a reset never do it:
        there, it takes the background away and nothing fills it again."""
        resets = 2 * self.reset_interval <= self.refine_stop
        return resets and self.reset_interval < step and self.refines_after(step)
