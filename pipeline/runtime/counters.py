"""The counters of a stage: counts and measures of its result, recorded in ``stage.json``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from pipeline.runtime.record import STAGE, read_stage, rerun, unreadable


class StageCounters(BaseModel):
    """Base of the counters of each stage.

    Subclasses are defined in the stage's room, in a module without slow imports: the Snakefile
    imports every declaration. A field with a default that a stage does not set is not recorded.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def recorded(self) -> dict[str, Any]:
        """The ``counters`` of ``stage.json``."""
        return self.model_dump(mode="json", exclude_unset=True)

    def headline(self) -> str:
        """What the stage found or made, in a few words for the terminal; may be empty."""
        return ""


class NoCounters(StageCounters):
    """Counters of a stage that has none."""


C = TypeVar("C", bound=StageCounters)


@dataclass(frozen=True)
class Report(Generic[C]):
    """The result of a stage's work for its record.

    Attributes:
        counters: The stage's counters.
        decisions, warnings: The sentences for the log.
        num_cached: The number of results found in a cache. It is no counter, because it depends on
            earlier runs.
    """

    counters: C
    decisions: list[str]
    warnings: list[str] = field(default_factory=list)
    num_cached: int = 0


def read_counters(folder: Path, model: type[C]) -> C:
    """The counters of the finished stage with this folder.

    Args:
        model: The model of the stage's counters (``StageSpec.counters``).

    Raises:
        UserError: the stage's record is missing or damaged, belongs to another stage, or has
            counters that do not fit ``model``.
    """
    counters = read_stage(folder).counters
    try:
        return model.model_validate(counters)
    except ValidationError as error:
        raise unreadable(folder / STAGE, error, rerun(folder), ("counters",)) from None
