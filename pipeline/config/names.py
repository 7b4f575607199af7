"""The names of all options, and the option that an unknown name stands for."""

from __future__ import annotations

from collections.abc import Iterator
from difflib import SequenceMatcher
from typing import Any

from pydantic import BaseModel

from pipeline.config.options import sections_of

# Below this similarity, from 0 to 1, a name is not suggested.
_SIMILAR = 0.6
# What a name in the section where the unknown one stands has ahead of others.
_SAME_SECTION = 0.1


def all_names(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """The dotted paths of all sections and options; those of alternative sections come once."""
    for name, field in model.model_fields.items():
        yield prefix + name
        inner = (path for s in sections_of(field) for path in all_names(s, f"{prefix}{name}."))
        yield from dict.fromkeys(inner)


def nearest_option(model: type[BaseModel], path: str) -> str | None:
    """The dotted path of the option or section that was probably meant; None if none is similar.

    Args:
        model: The configuration.
        path: The dotted path of the unknown name. Options of the same name in other sections are
            found, too.
    """
    section, _, name = path.rpartition(".")
    matcher = SequenceMatcher(None, "", name.lower())

    def score(known: str) -> float:
        its_section, _, its_name = known.rpartition(".")
        matcher.set_seq1(its_name.lower())
        similar = matcher.ratio() if matcher.real_quick_ratio() >= _SIMILAR else 0.0
        return similar + _SAME_SECTION * (its_section == section) if similar >= _SIMILAR else 0.0

    # The first of equals is taken, and the options of experiments come last.
    names = sorted(all_names(model), key=lambda known: known.startswith("experiments"))
    best = max(names, key=score)
    return best if score(best) else None


def hint(model: type[BaseModel], path: str, value: Any, key: str = "") -> str:
    """A hint at the option that was probably meant by a path; empty if there is none.

    Args:
        value: The value that the unknown option was given.
        key: The last name of the path as it was written. The path of an option, written as one
            name, is no option.
    """
    meant = nearest_option(model, path)
    if meant is None or (meant == path and "." not in key):  # An option of another strategy.
        return ""
    moved = "." in key or meant.rpartition(".")[0] != path.rpartition(".")[0]
    example = ""
    if moved and isinstance(value, int | float | str):
        first, *sections, name = meant.split(".")
        inner = "".join(f"{section}: {{" for section in sections) + f"{name}: {str(value)[:20]}"
        example = f", as in --config '{first}={{{inner}}}{'}' * len(sections)}'"
    return f" (did you mean {meant}{example}?)"
