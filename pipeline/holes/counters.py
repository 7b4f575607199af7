"""Counters of the holes stage."""

from __future__ import annotations

from pydantic import Field

from pipeline.runtime.counters import StageCounters
from pipeline.runtime.text import counted


class HolesCounters(StageCounters):
    """Counters of the holes stage."""

    num_invented: int = Field(ge=0, description="Number of invented Gaussians.")
    painted_views: int = Field(ge=0, description="Number of views whose holes were painted.")
    invented_share: float = Field(
        ge=0, le=1, description="Mean share of invented pixels in the evaluated views."
    )

    def headline(self) -> str:
        return f"{counted(self.num_invented, 'Gaussian')} invented"
