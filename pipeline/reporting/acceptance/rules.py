"""The rules of acceptance, and the YAML file that sets them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from pipeline.config.config_file import read_config_file
from pipeline.config.section import (
    MAX_GAUSSIANS,
    FilePath,
    GaussianCount,
    Minutes,
    Section,
    Share,
    Unit,
)
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import COMMAND
from pipeline.runtime.suggest import did_you_mean, nearest
from pipeline.runtime.text import shown

Decibels = Annotated[float, Field(ge=0, le=100), Unit("dB")]
Number = Annotated[int, Field(ge=0, le=MAX_GAUSSIANS), Unit("count")]
Megabytes = Annotated[float, Field(gt=0, le=1e8), Unit("MB")]
Metres = Annotated[float, Field(gt=0, le=1e6), Unit("metres")]
Factor = Annotated[float, Field(gt=0, le=1e6), Unit("factor")]

_FIX = f"see docs/reference/acceptance.md, or run {COMMAND} accept without --rules"
#: The rules that compare with the baseline.
BASELINE_RULES = ("max_psnr_drop", "max_ssim_drop", "max_time_factor", "max_memory_factor")


class Rules(Section):
    """Rules that a result must meet. null: the rule is not checked."""

    min_registered_share: Share | None = Field(
        0.9, description="Share of the photographs that have a pose, at least."
    )
    min_verdict: Literal["good", "weak"] | None = Field(
        "good",
        description="The verdict of the page, at least. good: the poses are certain, and the "
        "photographs are reproduced without overfitting; weak: not failed.",
    )
    min_psnr: Decibels | None = Field(25.0, description="Mean PSNR of the measured views.")
    min_ssim: Annotated[float, Field(ge=-1, le=1), Unit("index")] | None = Field(
        0.7, description="Mean SSIM of the measured views."
    )
    min_seen_share: Share | None = Field(
        0.5, description="Share of the visible surface that three or more photographs show."
    )
    max_gaps: Number | None = Field(
        0, description="Number of gaps between parts of the scene that could not be joined."
    )
    max_contradicted_share: Share | None = Field(
        0.1,
        description="Share of the pixels of views beside the photographs' places that contradict "
        "the photographs: floaters, veils and haze.",
    )
    max_floaters: Number | None = Field(
        None, description="Number of opaque Gaussians in front of cameras, before any surface."
    )
    max_gaussians: GaussianCount | None = Field(None, description="Number of trained Gaussians.")
    min_file_psnr: Decibels | None = Field(
        None,
        description="Lowest PSNR of the renders of a compressed file (SPZ, SOG, splat) against "
        "those of the exact Gaussians. Only for results with such a file.",
    )
    max_residual_m: Metres | None = Field(
        None,
        description="Median horizontal residual of the georeference. Only for scenes that GPS or "
        "ground control points place in metres.",
    )
    max_minutes: Minutes | None = Field(
        None, description="Time of all stages together, that of jobs side by side summed."
    )
    max_memory_mb: Megabytes | None = Field(None, description="Peak memory of any stage.")
    max_warnings: Number | None = Field(None, description="Number of warnings; 0 allows none.")
    max_psnr_drop: Decibels | None = Field(
        None, description="PSNR of the baseline less that of the result."
    )
    max_ssim_drop: Annotated[float, Field(ge=0, le=2), Unit("index")] | None = Field(
        None, description="SSIM of the baseline less that of the result."
    )
    max_time_factor: Factor | None = Field(
        None,
        description="Time of all stages divided by that of the baseline. Only for results of one "
        "machine without other load.",
    )
    max_memory_factor: Factor | None = Field(
        None, description="Peak memory divided by that of the baseline."
    )
    baseline: FilePath | None = Field(
        None,
        description="Result to compare with, relative to the file of rules: an accepted.json, the "
        "folder of a result, or a metrics.json, which has neither times nor memory.",
    )

    @classmethod
    def of(cls, **values: Any) -> Self:
        """These rules alone; others are not checked."""
        return cls.model_validate(dict.fromkeys(cls.model_fields) | values)

    @model_validator(mode="after")
    def _has_a_rule(self) -> Self:
        if all(value is None for name, value in self if name != "baseline"):
            raise ValueError("expected at least one rule, found none")
        return self


def read_rules(path: Path) -> Rules:
    """The rules of a YAML file; those that it leaves out are not checked. ``baseline`` becomes
    relative to the working folder.

    Raises:
        UserError: The file cannot be read, a rule is unknown, or its value is impossible.
    """
    content = read_config_file(path, example="min_psnr: 26", fix=_FIX)
    try:
        rules = Rules.of(**{str(name): value for name, value in content.items()})
    except ValidationError as error:
        lines = dict.fromkeys(_line(problem) for problem in error.errors(include_url=False)[:10])
        what = "\n  ".join(["the rules are not valid:", *lines])
        raise UserError(what, file=path, fix=_FIX) from None
    if rules.baseline is None:
        return rules
    return rules.model_copy(update={"baseline": str(path.parent / rules.baseline)})


def _line(problem: Any) -> str:
    """One line on a rule that is unknown or has an impossible value."""
    name = ".".join(map(str, problem["loc"][:1]))
    if problem["type"] == "extra_forbidden":
        known = nearest(name, Rules.model_fields)
        return f"{name[:60]}: there is no such rule{did_you_mean(known)}"
    message = problem["msg"].removeprefix("Value error, ")
    return f"{name}: {message}, found {shown(problem['input'])}" if name else message
