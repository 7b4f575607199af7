"""The existing name that was probably meant by one that does not exist."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

from pipeline.runtime.errors import UserError


def nearest(word: str, names: Iterable[str]) -> str | None:
    """The name that is most similar to ``word``, regardless of case; None if none is similar."""
    by_lower = {name.lower(): name for name in reversed([*names])}
    close = get_close_matches(word.lower()[:200], by_lower, n=1)
    return by_lower[close[0]] if close else None


def did_you_mean(name: object | None) -> str:
    """The question for a name that was found; empty for None."""
    return "" if name is None else f" (did you mean {name}?)"


def nearest_path(path: Path, *, folders: bool = False) -> Path | None:
    """The existing path that was probably meant by a missing one.

    Names in the folder of the first missing part are compared, and those in ``results/``, because
    the folder of a scene's results has the scene's name.

    Args:
        folders: Whether only a folder can be meant.
    """
    missing = next((p for p in reversed([path, *path.parents]) if not p.exists()), path)
    for folder in (missing.parent, Path("results")):
        found = nearest(missing.name, _names_in(folder, folders))
        if found is not None:
            whole = folder / found / path.relative_to(missing)
            return whole if whole.exists() else folder / found
    return None


def check_exists(path: Path, fix: str = "correct the path") -> None:
    """Raises: UserError: there is no such file or folder; the message names a similar one."""
    if not path.exists():
        meant = did_you_mean(nearest_path(path))
        raise UserError(f"no such file or folder{meant}", file=path, fix=fix)


def _names_in(folder: Path, only_folders: bool) -> list[str]:
    try:
        paths = sorted(folder.iterdir())
    except OSError:
        return []
    return [p.name for p in paths if p.name[0] != "." and (p.is_dir() or not only_folders)]
