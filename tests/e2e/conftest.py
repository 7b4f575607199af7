"""One finished run of the tiny scene, shared by the tests that start from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.harness import TINY, copy_project, make_scene, snakemake


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """A project whose scene ``tiny`` was reconstructed from photographs on two cores."""
    project = copy_project(tmp_path_factory.mktemp("e2e") / "project")
    make_scene(project, "tiny")
    snakemake(project, "results/tiny/metrics.json", config=TINY)
    return project
