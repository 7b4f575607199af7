"""The judgement of a result by rules (``accepted.json``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal, NamedTuple

from pydantic import Field

from pipeline.reporting.acceptance.measured import Measured, differences
from pipeline.reporting.acceptance.rules import BASELINE_RULES, Rules
from pipeline.runtime.errors import UserError
from pipeline.runtime.json_file import JsonFile, JsonObject

_GRADES = ("failed", "weak", "good")
# Digits that a figure may be shown with, so that rounding never hides a rule that is not met.
_MOST_DIGITS = 9


class Finding(JsonObject):
    """A rule and what was found."""

    rule: str = Field(description="The name of the rule.")
    title: str = Field(description="What it is about.")
    wanted: str = Field(description="The bound, with its unit.")
    found: str = Field(description="The figure, with its unit, or why there is none.")
    met: bool = Field(description="Whether the result meets the rule.")

    @property
    def sentence(self) -> str:
        """As in "PSNR 24.10 dB, at least 26 dB wanted"."""
        return f"{self.title} {self.found}, {self.wanted} wanted"


class Acceptance(JsonFile, JsonObject):
    """Whether a result meets rules, and why."""

    file_name: ClassVar[str] = "accepted.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    accepted: bool = Field(description="Whether all rules are met.")
    findings: tuple[Finding, ...] = Field(description="Of each rule that was checked.")
    measured: Measured = Field(
        description="The figures of the result; a later one is compared with them."
    )
    baseline: Measured | None = Field(description="The figures of the baseline; null without.")

    @property
    def badge(self) -> str:
        """In a line: accepted, or each rule that is not met."""
        broken = [finding.sentence for finding in self.findings if not finding.met]
        return f"not accepted: {'; '.join(broken)}" if broken else "accepted"


class _Check(NamedTuple):
    """How a rule is checked.

    Attributes:
        title: What the rule is about.
        value: The figure of a result and its baseline; None if it was not measured.
        unit: The unit of the figure; "%" for a share.
        digits: Decimals of the figure.
        missing: Why there may be no figure.
    """

    title: str
    value: Callable[[Measured, Measured], float | None]
    unit: str = ""
    digits: int = 0
    missing: str = ""


def _field(name: str) -> Callable[[Measured, Measured], float | None]:
    return lambda result, _: getattr(result, name)


def _drop(name: str) -> Callable[[Measured, Measured], float | None]:
    return lambda result, baseline: getattr(baseline, name) - getattr(result, name)


def _factor(name: str) -> Callable[[Measured, Measured], float | None]:
    def value(result: Measured, baseline: Measured) -> float | None:
        ours, theirs = getattr(result, name), getattr(baseline, name)
        return ours / theirs if ours is not None and theirs else None

    return value


_CHECKS = {
    "min_registered_share": _Check(
        "photographs placed", _field("registered_share"), "%", 1, "no stage has counted them"
    ),
    "min_psnr": _Check("PSNR", _field("psnr"), "dB", 2),
    "min_ssim": _Check("SSIM", _field("ssim"), "", 4),
    "min_seen_share": _Check(
        *("surface in three or more photographs", _field("seen_share"), "%", 1),
        "no training view sees a surface",
    ),
    "max_gaps": _Check("gaps between parts of the scene", _field("gaps")),
    "max_contradicted_share": _Check(
        *("contradictions beside the photographs", _field("contradicted_share"), "%", 1),
        "there is no free place beside the cameras",
    ),
    "max_floaters": _Check("floaters", _field("floaters"), "", 0, "no surface is certain"),
    "max_gaussians": _Check("Gaussians", _field("gaussians")),
    "min_file_psnr": _Check(
        *("PSNR of the lossiest file", _field("file_psnr"), "dB", 2),
        "no compressed file was exported, or the scene is too large",
    ),
    "max_residual_m": _Check("residual of the georeference", _field("residual_m"), "m", 3),
    "max_minutes": _Check("time", _field("minutes"), "minutes", 1),
    "max_memory_mb": _Check("peak memory", _field("memory_mb"), "MB", 0),
    "max_warnings": _Check("warnings", _field("warnings")),
    "max_psnr_drop": _Check("PSNR below the baseline", _drop("psnr"), "dB", 2),
    "max_ssim_drop": _Check("SSIM below the baseline", _drop("ssim"), "", 4),
    "max_time_factor": _Check("time against the baseline", _factor("minutes"), "times", 2),
    "max_memory_factor": _Check("memory against the baseline", _factor("memory_mb"), "times", 2),
}


def judge(rules: Rules, measured: Measured, baseline: Measured | None = None) -> Acceptance:
    """Judge a result. A figure that was not measured does not meet its rule.

    Args:
        baseline: The figures of the result to compare with; None without rules that compare.

    Raises:
        UserError: A rule does not suit the result: it compares and there is no baseline, the
            baseline is not comparable, or it is about metres and the scene has none.
    """
    _check_suitable(rules, measured, baseline)
    findings = []
    for name, wanted in rules:
        if wanted is None or name == "baseline":
            continue
        if name == "min_verdict":
            findings.append(_verdict_finding(wanted, measured))
        else:
            findings.append(_finding(name, wanted, measured, baseline or measured))
    return Acceptance(
        accepted=all(finding.met for finding in findings),
        findings=tuple(findings),
        measured=measured,
        baseline=baseline,
    )


def _check_suitable(rules: Rules, measured: Measured, baseline: Measured | None) -> None:
    if rules.max_residual_m is not None and measured.residual_m is None:
        raise UserError(
            f"max_residual_m: expected a scene that is placed in metres, found that of "
            f"{measured.scene} without GPS or ground control points",
            fix="leave the rule out for this scene",
        )
    comparing = [name for name in BASELINE_RULES if getattr(rules, name) is not None]
    if not comparing:
        return
    if baseline is None:
        raise UserError(
            f"{comparing[0]}: expected a baseline to compare with, found none",
            fix="name one with --baseline, or as baseline in the file of rules",
        )
    for name in ("max_time_factor", "max_memory_factor"):
        if name in comparing and not baseline.minutes:
            raise UserError(
                f"{name}: expected a baseline with times and memory, found a metrics.json, which "
                "has none",
                fix="use the accepted.json or the results folder of that result",
            )
    if found := differences(measured, baseline):
        raise UserError(
            f"the baseline cannot be compared with this result: {'; '.join(found)}",
            fix="compare with a result of the same scene, resolution and test views",
        )


def _verdict_finding(wanted: str, measured: Measured) -> Finding:
    met = _GRADES.index(measured.verdict) >= _GRADES.index(wanted)
    bound = "good" if wanted == "good" else f"at least {wanted}"
    title = "verdict on the reconstruction"
    found = measured.verdict
    return Finding(rule="min_verdict", title=title, wanted=bound, found=found, met=met)


def _finding(name: str, wanted: float, measured: Measured, baseline: Measured) -> Finding:
    check = _CHECKS[name]
    value = check.value(measured, baseline)
    is_least = name.startswith("min_")
    bound = f"{'at least' if is_least else 'at most'} {_with_unit(f'{wanted:,.12g}', check)}"
    if check.unit == "%":
        bound = f"{'at least' if is_least else 'at most'} {100 * wanted:.12g} %"
    if value is None:
        found, met = f"not measured ({check.missing})", False
    else:
        found = _shown(value, wanted, check)
        met = value >= wanted if is_least else value <= wanted
        if name in ("min_psnr", "min_ssim") and not measured.has_test_views:
            found += " on training views"
    return Finding(rule=name, title=check.title, wanted=bound, found=found, met=met)


def _shown(value: float, wanted: float, check: _Check) -> str:
    """A figure with its unit, in as many decimals as show on which side of the bound it is."""
    factor = 100 if check.unit == "%" else 1
    digits = check.digits
    while digits < _MOST_DIGITS and value != wanted:
        if (round(factor * value, digits) > factor * wanted) == (value > wanted) and (
            round(factor * value, digits) != factor * wanted
        ):
            break
        digits += 1
    return _with_unit(f"{factor * value:,.{digits}f}", check)


def _with_unit(number: str, check: _Check) -> str:
    return f"{number} {check.unit}".rstrip()


def table(judged: Acceptance) -> list[str]:
    """The rules as lines of text with what is wanted and found, and last the judgement."""
    rows = [("rule", "wanted", "found", "")]
    rows += [(f.rule, f.wanted, f.found, "met" if f.met else "not met") for f in judged.findings]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return [*lines, f"{judged.measured.scene}: {judged.badge}"]
