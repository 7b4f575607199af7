"""Counters of the train stage."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from pipeline.runtime.counters import StageCounters
from pipeline.runtime.text import counted


class ChangeCounters(BaseModel):
    """Numbers of Gaussians that density control changed."""

    model_config = StageCounters.model_config

    cloned: int = Field(ge=0, description="Number of Gaussians that were cloned.")
    split: int = Field(ge=0, description="Number of Gaussians that were split.")
    relocated: int = Field(
        ge=0, description="Number of useless Gaussians that were moved onto others."
    )
    pruned: int = Field(ge=0, description="Number of Gaussians that were removed.")


class TrainCounters(StageCounters):
    """Counters of the train stage."""

    num_gaussians: int = Field(ge=0, description="Number of trained Gaussians.")
    device: Literal["cpu", "gpu"] = Field(
        "cpu", description="What computed the steps: the processor, or a GPU (`run.json` names it)."
    )
    steps: int = Field(ge=0, description="Number of optimiser steps.")
    known_depths: int = Field(
        ge=0,
        description="Number of pixels with a known depth, over all training views; 0 without a "
        "loss on depths.",
    )
    depth_maps: int | None = Field(
        None,
        ge=0,
        description="Number of depth maps that are used; absent without a loss on depths.",
    )
    exposure_spread_stops: float | None = Field(
        None,
        description="Standard deviation of the photographs' exposures, stops; absent unless "
        "`train.appearance` is `measured`, and for photographs with alpha.",
    )
    vignetting_stops: float | None = Field(
        None,
        description="Stops by which corners are darker than the centre of the image, for the "
        "camera with the strongest vignetting; absent unless vignetting is modelled.",
    )
    slope_stops: float | None = Field(
        None,
        description="Change of brightness from the centre to the corner by the photographs' "
        "slopes, root mean square, stops; absent unless slopes are modelled.",
    )
    colour_disagreement: float | None = Field(
        None,
        description="Standard deviation of log2 of the colours of a point in neighbouring "
        "photographs, apart from exposure; absent unless `train.appearance` is `measured`, for "
        "photographs with alpha, and for blocks.",
    )
    changes: ChangeCounters = Field(
        description="Changes of the set of Gaussians by density control, totals of the run."
    )
    opacity_resets: int = Field(ge=0, description="Number of opacity resets.")
    max_gaussians: int = Field(ge=0, description="Largest number of Gaussians during the run.")
    num_dropped: int = Field(
        ge=0,
        description="Number of Gaussians that the rasterizer left out for numerical reasons, "
        "summed over the steps.",
    )
    blind_steps: int = Field(ge=0, description="Number of steps whose view saw no Gaussian.")
    unseen: int = Field(
        ge=0,
        description="Number of Gaussians removed at the end because no training view saw them.",
    )
    floaters: int = Field(
        ge=0,
        description="Number of Gaussians removed because they were close to a single camera, "
        "between neighbouring cameras, or before places beside the cameras.",
    )
    ghosts: int = Field(
        0,
        ge=0,
        description="Number of Gaussians removed because they explained mostly what was left out "
        "of the loss by `train.transients`.",
    )
    transient_views: int | None = Field(
        None,
        ge=0,
        description="Number of training views of which a part was left out of the loss by "
        "`train.transients`; absent if transients were not searched for.",
    )
    transient_share: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Share of the pixels of all training views that was left out of the loss by "
        "`train.transients`; absent if transients were not searched for.",
    )

    def headline(self) -> str:
        return f"{counted(self.num_gaussians, 'Gaussian')} after {counted(self.steps, 'step')}"
