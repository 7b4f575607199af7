"""One finished run of the tiny scene, shared by the tests that start from it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from filelock import FileLock

from tests.e2e.harness import TINY, copy_project, make_scene, snakemake


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """A project whose scene ``tiny`` was reconstructed from photographs on two cores.

    It is made by the first of pytest-xdist's workers that comes to it; tests must not change it.
    """
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    project = shared / "e2e-finished"
    done = shared / "e2e-finished.done"
    with FileLock(shared / "e2e-finished.lock"):
        if not done.exists():
            if project.exists():
                pytest.fail("another worker failed to reconstruct the tiny scene")
            copy_project(project)
            make_scene(project, "tiny")
            snakemake(project, "results/tiny/metrics.json", config=TINY)
            done.touch()
    return project
