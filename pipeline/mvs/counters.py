"""Counters of the dense stage."""

from __future__ import annotations

from pydantic import Field

from pipeline.runtime.counters import StageCounters
from pipeline.runtime.text import counted


class DenseCounters(StageCounters):
    """Counters of the dense stage."""

    depth_maps: int = Field(ge=0, description="Number of training views with a depth map.")
    without_sources: int = Field(
        ge=0, description="Number of training views without another view to match with."
    )
    completeness: float = Field(
        ge=0, le=1, description="Share of the pixels that are not masked with a depth."
    )
    confidence: float = Field(
        ge=0, le=1, description="Mean confidence of the pixels with a depth; 0 without any."
    )
    dense_points: int = Field(ge=0, description="Number of points of the fused cloud.")

    def headline(self) -> str:
        maps = counted(self.depth_maps, "depth map")
        return f"{maps}, {self.completeness:.0%} complete; {counted(self.dense_points, 'point')}"
