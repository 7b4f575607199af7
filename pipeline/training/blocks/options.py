"""The options of the parts of a training in blocks.

A coarse run gives every block its first Gaussians and its surroundings, and refines the cameras if
that is configured. Then each block is trained twice.
"""

from __future__ import annotations

from pipeline.config.experiments import TrainExperiments
from pipeline.config.schema import Train
from pipeline.scene.blocks import Block, Box, Partition
from pipeline.training.loop.schedule import Part, Schedule

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


def coarse_options(train: Train) -> Train:
    """The options of the coarse run of a scene that ``train`` trains in blocks."""
    return train.model_copy(
        update={
            "budget_minutes": _minutes(train, COARSE, 1.0),
            "sh_degree": min(COARSE_SH_DEGREE, train.sh_degree),
        }
    )


def block_options(
    train: Train,
    experiments: TrainExperiments,
    block: Block,
    part: Part,
    *,
    share: float,
    seen_share: float,
    initial: int,
) -> tuple[Train, TrainExperiments]:
    """The options of a part of the training of a block.

    Learning rates are those of a run of the whole scene, in which each Gaussian is seen in as many
    steps.

    Args:
        share: of the block in the cost of all.
        seen_share: mean share of its views that see one of its Gaussians.
        initial: number of its first Gaussians, all of which are kept.
    """
    whole = Schedule.of(train, experiments, seen_share)
    factor = experiments.learning_rate_factor
    if train.budget_minutes is None:
        factor = whole.learning_rate_factor(whole.steps)
    limit = max(block.max_gaussians, initial)
    density = train.density.model_copy(update={"max_gaussians": limit})
    return (
        train.model_copy(
            update={
                "steps": block.steps,
                "budget_minutes": _minutes(train, part, share),
                "refine_poses": False,
                "refine_intrinsics": False,
                "density": density,
            }
        ),
        experiments.model_copy(update={"coarse_share": 0.0, "learning_rate_factor": factor}),
    )


def _minutes(train: Train, part: Part, share: float) -> float | None:
    """The time budget of a part of the training."""
    minutes = train.budget_minutes
    return None if minutes is None else minutes * (part.end - part.begin) * share
