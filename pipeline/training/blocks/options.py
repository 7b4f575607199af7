"""The options of the parts of a training in blocks.

A coarse run gives every block its first Gaussians and its surroundings, and refines the cameras if
that is configured. Then each block is trained twice.
"""

from __future__ import annotations

from dataclasses import replace

from pipeline.config.settled import TrainOptions
from pipeline.scene.blocks import Block, Box, Partition
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.schedule import Schedule
from pipeline.training.run import Part, TrainingRun

# The parts of a run's schedule: on the whole scene, in blocks among the coarse Gaussians, and in
# blocks among what the other blocks have become. Alternating over subdomains that overlap is the
# Schwarz method of domain decomposition. The coarse part is long: what it leaves wrong around a
# block, the block would correct with haze in front of it.
COARSE, FIRST, SECOND = Part(0.0, 0.5), Part(0.5, 0.8), Part(0.8, 1.0)
# Overviews are trained on at 1 / this of their size.
OVERVIEW_FACTOR = 4
# View-dependent colours are left to the blocks.
COARSE_SH_DEGREE = 1


def corrected_box(partition: Partition, number: int, part: Part) -> Box:
    """What explains the part of an error that block ``number`` is to correct.

    What a block changes beyond its faces is lost in the union. In the first part it changes much,
    and corrects only as much as it keeps, so that errors remain where blocks meet. In the second,
    changes are small: each block corrects all that its region explains, and two blocks that correct
    the same error at a face each keep their part of it.
    """
    return partition.region(number) if part == SECOND else partition.kept(number)


def coarse_run(run: TrainingRun) -> TrainingRun:
    """The coarse run of a scene that ``run`` trains in blocks."""
    options = run.options
    changes = {
        "budget_minutes": _minutes(options, COARSE, 1.0),
        "sh_degree": min(COARSE_SH_DEGREE, options.sh_degree),
    }
    return replace(run, options=options.model_copy(update=changes), part=COARSE)


def block_run(run: TrainingRun, block: Block, *, share: float, inputs: Inputs) -> TrainingRun:
    """The training of a block by ``run``, which trains a part of the schedule of a whole scene.

    Learning rates are those of a run of the whole scene, in which each Gaussian is seen in as many
    steps.

    Args:
        share: The block's share of the cost of all blocks.
        inputs: The inputs of the block; all of its first Gaussians are kept.
    """
    options, experiments = run.options, run.options.experiments
    whole = Schedule.of(options, inputs.seen_share)
    factor = experiments.learning_rate_factor
    if options.budget_minutes is None:
        factor = whole.learning_rate_factor(whole.steps)
    limit = max(block.max_gaussians, len(inputs.initial))
    changes = {
        "steps": block.steps,
        "budget_minutes": _minutes(options, run.part, share),
        "refine_poses": False,
        "refine_intrinsics": False,
        "density": options.density.model_copy(update={"max_gaussians": limit}),
        "experiments": experiments.model_copy(
            update={"coarse_share": 0.0, "learning_rate_factor": factor}
        ),
    }
    return replace(run, options=options.model_copy(update=changes))


def _minutes(options: TrainOptions, part: Part, share: float) -> float | None:
    """The time budget of a part of the training."""
    minutes = options.budget_minutes
    return None if minutes is None else minutes * (part.end - part.begin) * share
