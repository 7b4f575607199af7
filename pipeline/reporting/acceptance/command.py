"""``splatmake accept``, and the judgement that a run's page shows."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from pipeline.reporting.acceptance.judge import Acceptance, judge, table
from pipeline.reporting.acceptance.measured import Measured, measured_in, read_baseline
from pipeline.reporting.acceptance.rules import Rules, read_rules
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError


class Criteria(BaseModel):
    """Rules with the figures of their baseline."""

    model_config = ConfigDict(frozen=True)

    rules: Rules
    baseline: Measured | None = None


def read_criteria(rules: Path | None, baseline: Path | None = None) -> Criteria:
    """The rules of a file, or the default ones, with the figures of their baseline.

    Args:
        rules: The YAML file; None for the default rules.
        baseline: The result to compare with, instead of the one that the file names.

    Raises:
        UserError: The rules or the baseline cannot be read.
    """
    read = Rules() if rules is None else read_rules(rules)
    named = baseline or (None if read.baseline is None else Path(read.baseline))
    return Criteria(rules=read, baseline=None if named is None else read_baseline(named))


def accept(
    scene: Path, rules: Path | None, baseline: Path | None = None, target: Path | None = None
) -> tuple[Acceptance, list[str]]:
    """Judge a finished scene.

    Args:
        scene: ``results/<scene>``.
        rules, baseline: As in ``read_criteria``.
        target: The file to write the judgement to.

    Returns:
        The judgement, and its table as lines.

    Raises:
        UserError: A file cannot be read, or a rule does not suit the scene.
    """
    criteria = read_criteria(rules, baseline)
    judged = judge(criteria.rules, measured_in(scene), criteria.baseline)
    if target is not None:
        write_json(target, judged.model_dump(mode="json"))
    return judged, table(judged)


def badge(criteria: Criteria, measured: Measured) -> str:
    """The judgement in a line, for the page; why there is none, if a rule does not suit the
    scene."""
    try:
        return judge(criteria.rules, measured, criteria.baseline).badge
    except UserError as error:
        return f"not judged: {error.what}"
