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
        "`export.region`, `export.max_gaussians` and `experiments.export.min_opacity`.",
    )

    psnr_against_all: float | None = Field(
        None,
        description="Mean PSNR, dB, of renders of the test views with the Gaussians that "
        "`export.max_gaussians` and `export.region` leave, against renders with all, over the "
        "pixels that show the region; null where nothing was left out.",
    )

    def headline(self) -> str:
        cost = self.psnr_against_all
        against = "" if cost is None else f", PSNR {cost:.2f} dB against all"
        return f"{counted(self.exported_gaussians, 'Gaussian')}{against}"
