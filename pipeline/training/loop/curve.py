"""The training curve (``curve.json``)."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field, RootModel

from pipeline.runtime.json_file import JsonFile, JsonObject


class CurveRecord(JsonObject):
    """The means since the previous record, over training views at the resolution in use."""

    step: int = Field(ge=0, description="Number of optimiser steps done.")
    loss: float = Field(description="Of photometric terms.")
    psnr: float = Field(description="Of the renders, dB.")
    num_gaussians: int = Field(ge=0, description="After the step.")


class TrainingCurve(JsonFile, RootModel[tuple[CurveRecord, ...]]):
    """About a hundred records, evenly spaced in the schedule. Their times are in ``run.json``
    (``curve_seconds``), because they differ between runs."""

    file_name: ClassVar[str] = "curve.json"
