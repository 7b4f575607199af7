"""One finished run of the tiny scene, shared by the tests that start from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.harness import TINY, make_project, make_scene, snakemake
from tests.once import made_once

# What the run has printed.
FIRST_RUN = "first_run.txt"


def reconstruct(project: Path) -> None:
    make_project(project)
    make_scene(project, "tiny")
    done = snakemake(project, "results/tiny/metrics.json", config=TINY)
    (project / FIRST_RUN).write_text(done.stdout)


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """A project whose scene ``tiny`` was reconstructed from photographs on two cores."""
    return made_once(tmp_path_factory, "e2e-finished", reconstruct)
