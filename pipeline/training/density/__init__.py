"""Density control: strategies that densify and prune Gaussians, one in each module."""

from pipeline.config.density import Gradient, Mcmc, Original
from pipeline.config.settled import TrainOptions
from pipeline.splats.skybox import Sky
from pipeline.training.density.gradient import GradientDensity
from pipeline.training.density.mcmc import McmcDensity
from pipeline.training.density.original import OriginalDensity
from pipeline.training.density.strategy import Changes, DensityStep, Strategy, Update

__all__ = [
    "Changes",
    "DensityStep",
    "GradientDensity",
    "McmcDensity",
    "OriginalDensity",
    "Strategy",
    "Update",
    "make_strategy",
]


def make_strategy(
    options: TrainOptions, *, steps: int, scale: float, extent: float, sky: Sky | None = None
) -> Strategy:
    """The strategy that ``options.density`` names.

    Args:
        steps: The length of the schedule.
        scale: The size of the scene (``training.data.known_depths.scene_scale``), world units.
        extent: 3DGS's size of the scene (``scene.views.scene_extent``), world units.
        sky: None without a skybox.
    """
    match options.density:
        case Mcmc():
            return McmcDensity(options.experiments.mcmc, steps, scale)
        case Original():
            return OriginalDensity(steps, extent)
        case Gradient():
            return GradientDensity(options.experiments.gradient, steps, scale, sky)
