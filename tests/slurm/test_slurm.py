"""The Slurm profile on a real Slurm: the same bits as a local run, also after a fault."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.runtime.record import file_digest
from tests.e2e.harness import TINY, command, copy_project, copy_run, environment, make_scene
from tests.slurm.cluster import Cluster, missing_programs, running
from tests.tools import unsupported

TARGET = "results/tiny/metrics.json"
CONFIG = TINY | {"train": {"steps": 2500, "density": {"max_gaussians": 6_000}}}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    if missing := missing_programs():
        unsupported(f"a cluster on one machine needs {', '.join(missing)} (slurm-wlm, munge)")
    # Sockets are in this folder, and their paths must be short.
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    try:
        with running(folder) as found:
            yield found
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with the results of a local run."""
    project = copy_project(tmp_path_factory.mktemp("local") / "project")
    make_scene(project, "tiny")
    line = command(TARGET, config=CONFIG)
    subprocess.run(line, cwd=project, env=environment(project), check=True, capture_output=True)
    return project


@pytest.fixture(scope="module")
def submitted(cluster: Cluster, local: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with the results of the documented command."""
    project = copy_project(tmp_path_factory.mktemp("slurm") / "project")
    shutil.copytree(local / "data", project / "data")
    done = subprocess.run(
        slurm_command(), cwd=project, env=on(cluster, project), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return project


def slurm_command() -> list[str]:
    line = command("--workflow-profile", "profiles/slurm", TARGET, config=CONFIG)
    at = line.index("--cores")  # the profile's command has none
    return [*line[:at], *line[at + 2 :], "--slurm-init-seconds-before-status-checks", "1"]


def on(cluster: Cluster, project: Path) -> dict[str, str]:
    return cluster.environment | environment(project) | {"PATH": cluster.environment["PATH"]}


def same_scene(one: Path, other: Path) -> bool:
    files = [project / "results" / "tiny" / "train" / "gaussians.npz" for project in (one, other)]
    return file_digest(files[0]) == file_digest(files[1])


def test_the_documented_command_gives_the_bits_of_a_local_run(
    cluster: Cluster, local: Path, submitted: Path
) -> None:
    assert same_scene(local, submitted)
    # Three jobs, each with the one core of its node and a limit of its time.
    jobs = cluster.run("squeue", "-h", "-t", "all", "-o", "%T %C %l").splitlines()
    assert [line.split()[:2] for line in jobs] == 3 * [["COMPLETED", "1"]]
    assert all("UNLIMITED" not in line for line in jobs)


def test_a_cancelled_training_goes_on_from_where_it_was(
    cluster: Cluster, local: Path, submitted: Path, tmp_path: Path
) -> None:
    project = copy_run(submitted, tmp_path / "project")
    results = project / "results" / "tiny"
    shutil.rmtree(results / "train")
    known = set(cluster.run("squeue", "-h", "-t", "all", "-o", "%i").split())
    log = results / "logs" / "train.log"
    log.unlink()
    process = subprocess.Popen(
        slurm_command(), cwd=project, env=on(cluster, project), stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: "ms a step" in log.read_text() if log.exists() else False)
    (job,) = cluster.jobs().keys() - known
    cluster.run("scancel", job)
    wait_for(lambda: "which a checkpoint keeps" in log.read_text())
    _, errors = process.communicate(timeout=400)
    assert process.returncode == 0, errors[-3000:]
    assert same_scene(local, project)
    record = (results / "train" / "run.json").read_text()
    assert '"earlier_s": 0.0' not in record, "training started over"


def wait_for(condition, seconds: float = 300) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.2)
