"""Counters of the export stage."""

from __future__ import annotations

from pydantic import Field

from pipeline.runtime.counters import StageCounters
from pipeline.runtime.json_file import JsonObject
from pipeline.runtime.text import counted


class FileLoss(JsonObject):
    """The loss of a file of Gaussians that does not hold every bit of them."""

    file: str = Field(description="Name in `export/`.")
    size_mb: float = Field(ge=0, description="Size of the file, millions of bytes.")
    psnr: float = Field(
        description="Mean PSNR (dB) of renders of the file, as it is read, against those of the "
        "Gaussians in `point_cloud.ply`: up to four test views at the size of training; 100 for "
        "equal pictures."
    )


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
    losses: list[FileLoss] = Field(
        [], description="The loss of each compressed file; none above 2 million Gaussians."
    )

    def headline(self) -> str:
        cost = self.psnr_against_all
        against = "" if cost is None else f", PSNR {cost:.2f} dB against all"
        return f"{counted(self.exported_gaussians, 'Gaussian')}{against}"
