"""The ``--config`` of ``splatmake``: names of options, also dotted ones, and values in YAML."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import yaml

from pipeline.config.load import Project
from pipeline.config.names import all_names, nearest_option
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import COMMAND
from pipeline.runtime.suggest import did_you_mean

# Below these, names are the user's.
_FREE = ("scenes", "configs")


def as_snakemake_reads(entries: Sequence[str]) -> list[str]:
    """The entries with dotted names as mappings (``train.steps=100`` as ``train={steps: 100}``).
    Snakemake merges entries of the same section.

    Args:
        entries: The ``name=value`` entries.

    Raises:
        UserError: There is no such option, or a value is not YAML.
    """
    return [_entry(*text.split("=", 1)) for text in entries]


def _entry(name: str, text: str) -> str:
    sections = name.strip().split(".")
    if sections[0] not in _FREE and ".".join(sections) not in all_names(Project):
        meant = nearest_option(Project, ".".join(sections))
        example = None if meant is None else f"--config {meant}={text[:40]}"
        raise UserError(
            f"--config {name}: no such option{did_you_mean(example)}",
            fix=f"{COMMAND} options lists all options, {COMMAND} options NAME explains one",
        )
    if sections[0] == "data_root":
        raise UserError("--config data_root: FOLDER says where the photographs are", fix="omit it")
    value = _parsed(name, text)
    if len(sections) == 1:
        return f"{sections[0]}={text}"
    for section in reversed(sections[1:]):
        value = {section: value}
    return f"{sections[0]}= {json.dumps(value, ensure_ascii=False)} "


def _parsed(name: str, text: str) -> Any:
    """The value as Snakemake reads it: all scalars are texts, which the configuration converts."""
    try:
        return yaml.load(text, Loader=yaml.BaseLoader)
    except yaml.YAMLError as error:
        problem = getattr(error, "problem", None) or type(error).__name__
        raise UserError(
            f"--config {name}: expected a value in YAML, found {text[:80]!r}: {problem}",
            fix="close each brace and bracket, and quote the whole, as in --config 'train={steps: "
            "2000}'; or write --config train.steps=2000",
        ) from None
