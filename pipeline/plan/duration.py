"""Estimates of the stages' durations, from which a cluster's time limits are made.

They are for two cores of a slow machine; time limits are a multiple of them. Rates were measured
with the scenes of ``benchmarks/records``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from pipeline.plan.values import Plan

# Time limits are this many times the estimate, and at least this many minutes: nodes differ, and a
# job that is killed for its time starts again from its checkpoint.
MARGIN, MIN_MINUTES = 4, 10
# The time in seconds that a user's command may take to paint the holes of all views.
MAX_PAINTING_S = 3600.0
# The number of pairs per photograph where not all pairs are matched.
NEIGHBOURS = 40


def minutes(stage: str, plan: Plan) -> int:
    """The time limit of a stage in minutes."""
    return max(MIN_MINUTES, math.ceil(MARGIN * seconds(stage, plan) / 60))


def seconds(stage: str, plan: Plan) -> float:
    """The estimated duration of a stage in seconds."""
    estimate = _ESTIMATES.get(stage)
    return estimate(plan) if estimate is not None else _PROGRAM


_PROGRAM = 10.0
"""Starting Python, importing torch, reading and writing files."""


def _photos(plan: Plan) -> int:
    return plan.facts.photographs + plan.facts.max_frames


def _per_photo(rate: float) -> Callable[[Plan], float]:
    return lambda plan: _PROGRAM + rate * _photos(plan)


def _decode(plan: Plan) -> float:
    return _PROGRAM + 4 * plan.facts.linear + 0.1 * plan.facts.video_frames + _photos(plan)


def _extract(plan: Plan) -> float:
    return _PROGRAM + 1.5 * plan.photos_per_job


def _features(plan: Plan) -> float:
    return _extract(plan) if plan.is_one_job else _gather(plan)


def _match(plan: Plan) -> float:
    count = _photos(plan)
    pairs = count * (count - 1) // 2
    if plan.config.matches.pairs != "exhaustive":
        pairs = min(pairs, NEIGHBOURS * count)
    return _PROGRAM + 0.05 * pairs * plan.photos_per_job / max(count, 1)


def _matches(plan: Plan) -> float:
    return _match(plan) if plan.is_one_job else _gather(plan)


def _gather(plan: Plan) -> float:
    return _PROGRAM + 0.1 * _photos(plan)


def _train(plan: Plan) -> float:
    if plan.config.partition.blocks != 1:
        return _PROGRAM
    return _PROGRAM + 0.2 * _photos(plan) + _steps(plan)


def _steps(plan: Plan) -> float:
    """The duration of training a whole scene in seconds."""
    train = plan.config.train
    width, height = plan.facts.view_size
    step = 0.005 + 1e-7 * train.density.max_gaussians + 6e-8 * width * height
    return train.steps * step if train.budget_minutes is None else 60 * train.budget_minutes


def _dense(plan: Plan) -> float:
    width, height = plan.facts.view_size
    return _PROGRAM + 1.2e-5 * width * height * _photos(plan)


def _holes(plan: Plan) -> float:
    painted = 0.0 if plan.config.holes.fill == "inpaint" else MAX_PAINTING_S
    return _per_photo(2.0)(plan) + 60 + painted


def _coarse(plan: Plan) -> float:
    return _PROGRAM + 0.2 * _photos(plan) + _steps(plan)


def _block(plan: Plan) -> float:
    # A block has at most all views, but its windows in them are smaller.
    return _PROGRAM + _photos(plan) + _steps(plan)


_ESTIMATES: Mapping[str, Callable[[Plan], float]] = {
    "inspect": _per_photo(0.2),
    "decode": _decode,
    "extract": _extract,
    "features": _features,
    "pairs": _per_photo(0.2),
    "match": _match,
    "matches": _matches,
    "sfm": _per_photo(3.0),
    "refine": _per_photo(2.0),
    "undistort": _per_photo(0.5),
    "dense": _dense,
    "init": _per_photo(1.0),
    "coarse": _coarse,
    "partition": _per_photo(1.0),
    "block": _block,
    "polish": _block,
    "train": _train,
    "holes": _holes,
    "evaluate": _per_photo(0.5),
    "coverage": _per_photo(1.0),
    "export": _per_photo(0.5),
}
