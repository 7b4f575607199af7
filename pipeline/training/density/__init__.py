"""Density control: which Gaussians there are. A strategy a file, all behind one interface."""

from pipeline.config.schema import Density
from pipeline.training.density.gradient import GradientDensity
from pipeline.training.density.mcmc import McmcDensity
from pipeline.training.density.strategy import Changes, Strategy

__all__ = ["Changes", "GradientDensity", "McmcDensity", "Strategy", "make_strategy"]


def make_strategy(config: Density, extent: float) -> Strategy:
    """What ``config.strategy`` names; ``extent`` is the scene's size in the world's unit."""
    if config.strategy == "mcmc":
        return McmcDensity(config, extent)
    return GradientDensity(config, extent)
