"""Options by their dotted paths: which there are, and the values of those that a stage declares."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from pydantic import BaseModel

from pipeline.config.schema import Config
from pipeline.runtime.section import decides_nothing


def option_paths(model: type[BaseModel] = Config, prefix: str = "") -> Iterator[str]:
    """Dotted paths of all options that decide a result, in the order of the schema."""
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from option_paths(inner, f"{prefix}{name}.")
        elif not decides_nothing(model, name):
            yield prefix + name


def select(config: Config, paths: Iterable[str]) -> dict[str, Any]:
    """The values of the options at or below ``paths``, nested as in the schema, JSON types.

    Raises:
        KeyError: there is no such option.
    """
    dumped = config.model_dump(mode="json")
    known = list(option_paths())
    selected: dict[str, Any] = {}
    for path in paths:
        below = [name for name in known if name == path or name.startswith(f"{path}.")]
        if not below:
            raise KeyError(path)
        for name in below:
            *sections, option = name.split(".")
            source, target = dumped, selected
            for section in sections:
                source, target = source[section], target.setdefault(section, {})
            target[option] = source[option]
    return selected
