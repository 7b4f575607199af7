"""Options by their dotted paths: their names, and the values of those that a stage declares."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from pipeline.config.schema import Config
from pipeline.runtime.section import decides_nothing


def sections_of(field: FieldInfo) -> tuple[type[BaseModel], ...]:
    """The section that a field holds, or the alternatives of a union; empty for an option."""
    kinds = (field.annotation, *get_args(field.annotation))
    return tuple(k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel))


def option_paths(model: type[BaseModel] = Config, prefix: str = "") -> Iterator[str]:
    """The dotted paths of all options that decide a result, in the order of the schema.

    Alternatives of a union have their options at the same place: each path comes once.
    """
    for name, field in model.model_fields.items():
        sections = sections_of(field)
        if sections:
            paths = (p for section in sections for p in option_paths(section, f"{prefix}{name}."))
            yield from dict.fromkeys(paths)
        elif not decides_nothing(model, name):
            yield prefix + name


@cache
def _all_paths() -> tuple[str, ...]:
    return tuple(option_paths())


def select(config: Config, paths: Iterable[str]) -> dict[str, Any]:
    """The values of the options at or below ``paths``, nested as in the schema, of JSON types.

    Raises:
        KeyError: There is no such option.
    """
    dumped = config.model_dump(mode="json")
    selected: dict[str, Any] = {}
    for path in paths:
        below = [name for name in _all_paths() if name == path or name.startswith(f"{path}.")]
        if not below:
            raise KeyError(path)
        for name in below:
            *sections, option = name.split(".")
            source, target = dumped, selected
            for section in sections:
                source, target = source[section], target.setdefault(section, {})
            if option in source:  # Otherwise another alternative of a union has it.
                target[option] = source[option]
    return selected
