"""Counters of the partition stage."""

from __future__ import annotations

from pydantic import BaseModel, Field

from pipeline.runtime.counters import StageCounters
from pipeline.runtime.text import counted


class BlockCounters(BaseModel):
    """Counts of one block."""

    model_config = StageCounters.model_config

    views: int = Field(ge=0, description="Number of its training views.")
    pixels: int = Field(ge=0, description="Number of pixels of its windows in them.")
    gaussians: int = Field(ge=0, description="Number of coarse Gaussians, with its margin.")
    max_gaussians: int = Field(ge=0, description="Upper limit of the number of Gaussians.")
    steps: int = Field(ge=0, description="Number of optimiser steps.")


class PartitionCounters(StageCounters):
    """Counters of the partition stage."""

    blocks: list[BlockCounters] = Field(description="By number of the block.")
    largest_share: float = Field(
        ge=0, description="Pixels of the largest block's windows over the mean of all blocks."
    )

    def headline(self) -> str:
        return counted(len(self.blocks), "block")
