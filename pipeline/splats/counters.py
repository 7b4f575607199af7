"""Counters of the init stage."""

from __future__ import annotations

from pydantic import Field

from pipeline.runtime.counters import StageCounters
from pipeline.runtime.text import counted


class InitCounters(StageCounters):
    """Counters of the init stage."""

    num_gaussians: int = Field(ge=0, description="Number of initial Gaussians.")
    points: int = Field(
        ge=0, description="Number of sparse points, or points of the point cloud in a view."
    )
    dropped: int = Field(
        ge=0,
        description="Number of points left out because they are not finite, too near or too far.",
    )
    thinned: int = Field(
        ge=0, description="Number of points left out because there are more than `init.max_points`."
    )
    triangulated_points: int | None = Field(
        None,
        ge=0,
        description="Number of points triangulated with the given poses; absent where the poses "
        "have points.",
    )

    def headline(self) -> str:
        return f"{counted(self.num_gaussians, 'Gaussian')} from {counted(self.points, 'point')}"
