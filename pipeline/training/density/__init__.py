"""Density control: which Gaussians there are. A strategy a file, all behind one interface."""

from pipeline.config.schema import Density
from pipeline.training.density.gradient import GradientDensity
from pipeline.training.density.mcmc import McmcDensity
from pipeline.training.density.strategy import Changes, Strategy

__all__ = ["Changes", "GradientDensity", "McmcDensity", "Strategy", "make_strategy"]


def make_strategy(config: Density, scale: float) -> Strategy:
    """What ``config.strategy`` names; ``scale`` is ``training.data.known_depths.scene_scale``."""
    if config.strategy == "mcmc":
        return McmcDensity(config, scale)
    return GradientDensity(config, scale)
