"""Initial Gaussians of a training run, from sparse points or at random."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.config.experiments import InitExperiments
from pipeline.config.settled import Background, Init
from pipeline.scene.reconstruction import Points
from pipeline.scene.views import View
from pipeline.splats.counters import InitCounters
from pipeline.splats.init import InitGaussians, gaussians_from_points, gaussians_random
from pipeline.splats.skybox import SKYBOXES, with_skybox

# With fewer sparse points than this, Gaussians are initialised at random.
MIN_POINTS = 100


@dataclass(frozen=True)
class InitPoints:
    """The points that Gaussians are initialised from.

    Attributes:
        source: The name of the points in messages.
        normals: See ``gaussians_from_points``.
    """

    points: Points
    source: str = "points"
    normals: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class FirstGaussians:
    """Initial Gaussians, with the counters, decisions and warnings of the init stage."""

    gaussians: InitGaussians
    counters: InitCounters
    decisions: list[str]
    warnings: list[str] = field(default_factory=list)


def first_gaussians(
    init: InitPoints,
    training: Sequence[View],
    config: Init,
    experiments: InitExperiments,
    seed: int,
    background: Background = "black",
) -> FirstGaussians:
    """Initialise Gaussians from points, or at random if ``config.method`` is
    "random" or there are fewer than ``MIN_POINTS``.

    Args:
        training: The training views, for random initialisation and the scale of the scene.
        seed: The seed of random initialisation.
        background: What is behind the Gaussians: for "skybox" and "fill", more of them
            (``pipeline.splats.skybox``).
    """
    points, source = init.points, init.source
    method, warnings = config.method, []
    if method != "random" and len(points) < MIN_POINTS:
        warnings = [f"only {len(points)} sparse points: Gaussians are initialised at random"]
        method = "random"
    centres = np.array([view.centre for view in training])
    if method == "random":
        first = gaussians_random(list(training), 0, seed, experiments)
    else:
        first = gaussians_from_points(points, centres, config, 0, experiments, init.normals)
    source = "random positions" if method == "random" else source
    decisions = [f"{len(first)} Gaussians from {source}"]
    if background in SKYBOXES:
        count = len(first)
        first = with_skybox(first, centres, trained=background == "skybox")
        decisions.append(f"{len(first) - count} Gaussians of a {background} behind them")
    counters = InitCounters(
        num_gaussians=len(first),
        points=len(points),
        dropped=first.num_dropped,
        thinned=first.num_thinned,
    )
    return FirstGaussians(first, counters, decisions, warnings)
