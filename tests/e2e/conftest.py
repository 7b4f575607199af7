"""One finished run of the tiny scene, shared by the tests that start from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.harness import TINY, TINY_DEMO, copy_project, environment, snakemake, subprocess, sys


def make_scene(project: Path, scene: str, *options: str) -> None:
    """Make a tiny demo scene in ``data/<scene>`` of a project."""
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pipeline.demo",
            f"data/{scene}",
            *TINY_DEMO,
            *options,
        ],
        cwd=project,
        env=environment(project),
        check=True,
    )


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """A project whose scene ``tiny`` was reconstructed from photographs on two cores."""
    project = copy_project(tmp_path_factory.mktemp("e2e") / "project")
    make_scene(project, "tiny")
    snakemake(project, "results/tiny/metrics.json", config=TINY)
    return project
