"""Counters of the export stage."""

from __future__ import annotations

from pydantic import Field

from pipeline.runtime.counters import StageCounters
from pipeline.runtime.text import counted


class ExportCounters(StageCounters):
    """Counters of the export stage."""

    exported_gaussians: int = Field(
        ge=0,
        description="Number of Gaussians in each exported file, after "
        "`experiments.export.min_opacity`.",
    )

    def headline(self) -> str:
        return counted(self.exported_gaussians, "Gaussian")
