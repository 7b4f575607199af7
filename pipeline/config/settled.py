"""Settled options: the plan has replaced each "auto" by a value.

The stages read these types. Sections without an entry here have no option that is settled.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.config import schema
from pipeline.config.experiments import TrainExperiments
from pipeline.config.section import LossWeight

Background = Literal["skybox", "black", "white", "random"]
Device = Annotated[str, Field(pattern=r"^(cpu|gpu(:[0-9]{1,3})?)$")]


class Train(schema.Train):
    """The optimisation of the Gaussians. The defaults serve callers of the library."""

    device: Device = "cpu"
    background: Background = "black"
    appearance: Literal["measured", "none", "exposure", "embedding"] = "none"
    depth_loss_weight: LossWeight = 0.0


class TrainOptions(Train):
    """The options of the optimisation, with those of experiments."""

    experiments: TrainExperiments = Field(default_factory=TrainExperiments)


class Config(schema.Config):
    """All options of a scene."""

    train: Train = Field(default_factory=Train)
