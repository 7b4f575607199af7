"""Reading sections of options from a stage's key."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel

S = TypeVar("S", bound=BaseModel)


def read_section(model: type[S], values: Mapping[str, Any]) -> S:
    """The section ``model`` with the selected ``values``.

    Options that were not selected are removed from it, so that a stage that reads an option which
    it does not declare fails instead of using the default.
    """
    section = model.model_validate(dict(values))
    _remove_others(section, values)
    return section


def _remove_others(section: BaseModel, values: Mapping[str, Any]) -> None:
    for name in type(section).model_fields:
        inner = section.__dict__[name]
        if isinstance(inner, BaseModel):
            _remove_others(inner, values.get(name) or {})
        elif name not in values and not decides_nothing(type(section), name):
            del section.__dict__[name]


def decides_nothing(model: type[BaseModel], name: str) -> bool:
    """Whether the option is marked ``decides_result: False``: it affects time or memory only."""
    extra = model.model_fields[name].json_schema_extra
    return isinstance(extra, dict) and extra.get("decides_result") is False
