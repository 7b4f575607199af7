"""A project that a killed Snakemake left locked."""

from __future__ import annotations

from pathlib import Path

from tests.documented import commands
from tests.e2e.harness import make_project, snakemake


def test_the_documented_command_unlocks_the_folder(tmp_path: Path) -> None:
    """It names no target, so that it would scan all scenes: none of them can be planned here."""
    (command,) = {tuple(c.words) for c in commands() if "--unlock" in c.words}
    project = make_project(tmp_path / "project")
    (project / "data" / "empty").mkdir(parents=True)
    locks = project / ".snakemake" / "locks"
    locks.mkdir(parents=True)
    (locks / "0.output.lock").write_text("results/garden/metrics.json\n")
    done = snakemake(project, *command[1:], check=False)
    assert done.returncode == 0, done.stdout
    assert not list(locks.glob("*.lock"))
