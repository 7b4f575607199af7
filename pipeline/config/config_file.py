"""Checks of configuration files before Snakemake reads them, whose errors are tracebacks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from pipeline.runtime.errors import UserError
from pipeline.runtime.suggest import did_you_mean, nearest_path

_MAX_BYTES = 1 << 20
# Aliases can make a short file stand for any number of values.
_MAX_VALUES = 100_000
_FIX = "correct the file, or leave it out to use the defaults"


def check_config_file(path: Path) -> None:
    """Check that a configuration file can be read as a mapping.

    Raises:
        UserError: The file is not a text in UTF-8, not YAML, not a mapping, or too large.
    """
    if not path.is_fifo():  # A shell's <(command) can be read only once.
        read_config_file(path)


def read_config_file(path: Path, example: str = "preset: fast", fix: str = _FIX) -> dict[Any, Any]:
    """The mapping in a YAML file; an empty one for an empty file.

    Args:
        example: A line of such a file, for messages.
        fix: What to do about a file that cannot be read.

    Raises:
        UserError: The file is not a text in UTF-8, not YAML, not a mapping, or too large.
    """

    def wrong(what: str) -> UserError:
        return UserError(what, file=path, fix=fix)

    try:
        if path.exists() and not path.is_file():
            raise wrong("expected a file")
        if path.stat().st_size > _MAX_BYTES:
            raise wrong(f"expected at most {_MAX_BYTES >> 20} MiB, found a larger file")
        content = yaml.safe_load(path.read_bytes().decode("utf-8-sig"))
        count = _count(content, {})
    except OSError as error:
        meant = did_you_mean(None if path.exists() else nearest_path(path))
        raise wrong(f"cannot be read: {error.strerror}{meant}") from None
    except UnicodeDecodeError as error:
        raise wrong(f"expected text in UTF-8, found other bytes at {error.start}") from None
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as error:
        where = getattr(error, "problem_mark", None)
        line = f"line {where.line + 1}: " if where is not None else ""
        problem = getattr(error, "problem", None) or str(error) or type(error).__name__
        raise wrong(f"{line}expected YAML: {problem}"[:300]) from None
    if count > _MAX_VALUES:
        raise wrong(f"expected options, found {count} values (by aliases)")
    if content is not None and not isinstance(content, dict):
        raise wrong(f"expected a mapping of names to values ({example})")
    return content or {}


def _count(value: Any, known: dict[int, int]) -> int:
    """The number of values with all aliases expanded.

    Args:
        known: The number of values of each container by its id; 0 while it is counted.

    Raises:
        ValueError: A container holds itself.
    """
    if not isinstance(value, dict | list | set | tuple):
        return 1
    if id(value) in known:
        if not known[id(value)]:
            raise ValueError("an alias refers to a value that holds it")
        return known[id(value)]
    known[id(value)] = 0
    inner = value.values() if isinstance(value, dict) else value
    known[id(value)] = 1 + sum(_count(item, known) for item in inner)
    return known[id(value)]
