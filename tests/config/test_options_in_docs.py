"""The docs name options that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pipeline.config.options import option_paths
from pipeline.config.schema import Config

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GENERATED = ("options.md", "options-experiments.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_exist(page: Path) -> None:
    if page.name in GENERATED:
        return
    known = set(option_paths(Config))
    sections = {path.split(".")[0] for path in known if "." in path}
    inner = {".".join(path.split(".")[:n]) for path in known for n in range(1, path.count(".") + 1)}
    named = re.findall(r"`([a-z_]+(?:\.[a-zA-Z_0-9]+)+)(?::[^`]*)?`", page.read_text())
    files = re.compile(r"\.(json|md|png|py|html|csv|ply|spz|txt|log|toml|mp4)$")
    options = {n for n in named if n.split(".")[0] in sections and not files.search(n)}
    missing = {n for n in options - known - inner if not _is_there(n)}
    assert not missing, "renamed or removed options"


def _is_there(path: str) -> bool:
    """Also of options that decide no result, which ``option_paths`` leaves out."""
    value: object = Config()
    for name in path.split("."):
        if not hasattr(value, name):
            return False
        value = getattr(value, name)
    return True
