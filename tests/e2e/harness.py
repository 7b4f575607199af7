"""Runs Snakemake for real in folders that have the project's sources by symbolic links."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from tests.e2e.forking import Fork, ForkServer, write_python

ROOT = Path(__file__).resolve().parents[2]

# What each run of Snakemake and each of its jobs would import anew. Stages with pycolmap share no
# process with those with torch, and cv2 comes first: see CONTRIBUTING.md.
COMMON = ("cv2", "PIL.Image", "pydantic", "numpy.random", "scipy.sparse.csgraph", "scipy.spatial")
RUNS = ForkServer("snakemake.cli", "numpy", "pydantic", "stages.workflow.project")
TORCH_JOBS = ForkServer(
    *("torch", *COMMON, "scipy.ndimage", "stages.workflow.blocks", "pipeline.training.scene"),
    *("pipeline.metrics.evaluate", "pipeline.coverage.measure", "pipeline.export.write"),
    *("pipeline.reporting.collect", "pipeline.reporting.page", "pipeline.reporting.scene"),
)
OTHER_JOBS = ForkServer(
    *(*COMMON, "pycolmap", "stages.workflow.inputs", "pipeline.photos.verify"),
    *("pipeline.sfm.features", "pipeline.sfm.matching", "pipeline.sfm.mapping"),
    *("pipeline.photos.undistort", "pipeline.splats.init", "pipeline.demo.write"),
)
TORCH_STAGES = ("train", "evaluate", "coverage", "export", "report")
OTHER_STAGES = (
    *("inspect", "decode", "extract", "features", "pairs", "match", "matches", "sfm"),
    *("refine", "undistort", "dense", "init"),
)

SOURCES = ("Snakefile", "pipeline", "stages", "profiles", "pyproject.toml")

# Views 12 degrees apart: fewer overlap, and the test views still lie between others.
TINY_DEMO = ("--views", "20", "--size", "200x150")
# Small enough for a full run in well under a minute, large enough to go through densification.
TINY = {
    "views": {"max_long_side_px": 200},
    "train": {"steps": 240, "density": {"max_gaussians": 6_000}},
}


def make_project(target: Path) -> Path:
    """A folder with the project's sources, which tests must not change, and its configuration."""
    target.mkdir(parents=True)
    for name in SOURCES:
        (target / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "config", target / "config")
    return target


def copy_sources(project: Path) -> None:
    """Replace a project's links to the sources by copies, which tests may change."""
    for name in SOURCES:
        (project / name).unlink()
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, project / name)


def make_scene(project: Path, scene: str, *options: str) -> None:
    """Make a tiny demo scene in ``data/<scene>`` of a project."""
    # One process: starting more takes longer than they save.
    words = [f"data/{scene}", *TINY_DEMO, "--processes", "1", *options]
    code, said = run_fork(OTHER_JOBS, "pipeline.demo", words, project, Path(sys.executable))
    assert code == 0, said


def copy_run(source: Path, target: Path) -> Path:
    """Copy a project together with its results, keeping times, as if it had always been there."""
    subprocess.run(["cp", "-a", str(source), str(target)], check=True)
    return target


def environment(project: Path) -> dict[str, str]:
    return os.environ | {
        "PYTHONPATH": str(project),
        # The compiled extension of the project under test: same sources, same key.
        "SPLATMAKE_CACHE": os.environ.get("SPLATMAKE_CACHE", str(ROOT / "build" / "native")),
        "NO_COLOR": "1",
        # LPIPS weights of this machine would change what is expected.
        "TORCH_HOME": str(ROOT / "build" / "no-weights"),
    }


def arguments(*args: str, config: dict | None = None, cores: int = 2) -> list[str]:
    """Snakemake's command line behind the program's name."""
    line = ["--cores", str(cores), *args]
    if config is not None:
        line += ["--config", *(f"{name}={json.dumps(value)}" for name, value in config.items())]
    return line


def command(*args: str, config: dict | None = None, cores: int = 2) -> list[str]:
    return [sys.executable, "-m", "snakemake", *arguments(*args, config=config, cores=cores)]


@cache
def forking_python() -> Path:
    """The ``python`` of Snakemake's jobs."""
    folder = TORCH_JOBS.address.parent / "bin"
    folder.mkdir()
    return write_python(
        folder / "python",
        TORCH_JOBS.handles([f"-m stages {stage}" for stage in TORCH_STAGES]),
        OTHER_JOBS.handles(
            [
                *("-m stages.workflow.plan --out", "-m stages.workflow.batch --results"),
                *(f"-m stages {stage}" for stage in OTHER_STAGES),
            ]
        ),
    )


def start_snakemake(
    project: Path, *args: str, output: int, config: dict | None = None, cores: int = 2
) -> Fork:
    """Start Snakemake in ``project``; ``output`` receives stdout and stderr.

    It and its jobs are forks of processes that have imported large packages. If Snakemake and the
    rest of its process group are killed, so is its job.
    """
    return RUNS.start(
        "snakemake",
        arguments(*args, config=config, cores=cores),
        folder=project,
        environment=environment(project),
        output=output,
        python=forking_python(),
    )


def run_fork(
    server: ForkServer, module: str, words: Sequence[str], project: Path, python: Path
) -> tuple[int, str]:
    """The exit status of a module, and its stdout and stderr together."""
    with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
        run = server.start(
            module,
            words,
            folder=project,
            environment=environment(project),
            output=output.fileno(),
            python=python,
        )
        code = run.wait(timeout_s=900)
        output.seek(0)
        return code, output.read()


def snakemake(
    project: Path, *args: str, config: dict | None = None, cores: int = 2, check: bool = True
) -> subprocess.CompletedProcess[str]:
    """Run Snakemake in ``project`` to its end; stdout and stderr together in ``stdout``."""
    words = arguments(*args, config=config, cores=cores)
    code, said = run_fork(RUNS, "snakemake", words, project, forking_python())
    if check and code != 0:
        raise AssertionError(f"snakemake ended with {code}:\n{said}")
    return subprocess.CompletedProcess(words, code, said)


def rules_run(done: subprocess.CompletedProcess[str], scene: str | None = None) -> set[str]:
    """Names of the rules of which jobs were started, for one scene or for all."""
    if scene is None:
        return set(re.findall(r"^(?:local)?rule (\w+):", done.stdout, re.M))
    jobs = re.findall(
        r"^(?:local)?rule (\w+):\n(?: .*\n)*? +wildcards: scene=(\S+)$", done.stdout, re.M
    )
    return {rule for rule, of in jobs if of == scene}


def started(done: subprocess.CompletedProcess[str]) -> Counter[str]:
    """Rule -> number of its jobs that were started."""
    return Counter(re.findall(r"^(?:local)?rule (\w+):", done.stdout, re.M))


def start_and_kill(
    project: Path,
    target: str,
    ready: str,
    *,
    config: dict,
    cores: int = 2,
    only_snakemake: bool = False,
) -> None:
    """Start Snakemake and SIGKILL it, with its jobs or alone, once a file matching ``ready``
    (a glob below the project) exists."""
    with open(os.devnull, "w") as nothing:
        run = start_snakemake(project, target, output=nothing.fileno(), config=config, cores=cores)
    deadline = time.monotonic() + 300
    while not any(project.glob(ready)):
        assert not run.ended(), f"snakemake ended before {ready} appeared"
        assert time.monotonic() < deadline, f"{ready} never appeared"
        time.sleep(0.01)
    if only_snakemake:
        os.kill(run.pid, signal.SIGKILL)
    else:
        os.killpg(run.pid, signal.SIGKILL)
    run.wait()


def metrics(project: Path, scene: str) -> dict:
    """``metrics.json``: the same for the same work."""
    return json.loads((project / "results" / scene / "metrics.json").read_text())


def model_digests(project: Path, scene: str) -> dict[str, str]:
    """Digest of every file that makes up the result."""
    folder = project / "results" / scene
    files = [
        *(folder / "export").rglob("*"),
        *(folder / "evaluate").rglob("*"),
        *(folder / "coverage").rglob("*"),
        folder / "train" / "gaussians.npz",
        folder / "train" / "curve.json",
    ]
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(files)
        if file.is_file() and "run.json" not in file.name
    }
