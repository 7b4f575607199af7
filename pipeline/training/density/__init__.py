"""Density control: strategies that densify and prune Gaussians, one in each module."""

from pipeline.config.density import Gradient, Mcmc, Original
from pipeline.config.experiments import TrainExperiments
from pipeline.splats.skybox import Sky
from pipeline.training.density.gradient import GradientDensity
from pipeline.training.density.mcmc import McmcDensity
from pipeline.training.density.original import OriginalDensity
from pipeline.training.density.strategy import Changes, Strategy

__all__ = [
    "Changes",
    "GradientDensity",
    "McmcDensity",
    "OriginalDensity",
    "Strategy",
    "make_strategy",
]


def make_strategy(
    config: Gradient | Mcmc | Original,
    experiments: TrainExperiments,
    *,
    steps: int,
    scale: float,
    extent: float,
    sky: Sky | None = None,
) -> Strategy:
    """The strategy that ``config`` names.

    Args:
        steps: length of the schedule.
        scale: size of the scene (``training.data.known_depths.scene_scale``), world units.
        extent: 3DGS's size of the scene (``scene.views.scene_extent``), world units.
        sky: None without a skybox.
    """
    match config:
        case Mcmc():
            return McmcDensity(experiments.mcmc, steps, scale)
        case Original():
            return OriginalDensity(steps, extent)
        case Gradient():
            options = experiments.gradient
            if experiments.isotropic:  # a sphere has no longest axis
                options = options.model_copy(update={"split_kind": "sampled"})
            return GradientDensity(options, steps, scale, sky)
