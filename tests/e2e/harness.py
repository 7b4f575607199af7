"""Runs Snakemake for real on a copy of the project."""

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
from pathlib import Path

from tests.e2e.forking import ForkServer

ROOT = Path(__file__).resolve().parents[2]

# What each run of Snakemake, and each of its jobs that need torch, would import anew.
RUNS = ForkServer("snakemake.cli", "numpy", "pydantic")
JOBS = ForkServer("torch", "cv2", "PIL.Image", "numpy", "pydantic")
TORCH_JOBS = [
    f"-m stages {stage}" for stage in ("train", "evaluate", "coverage", "export", "report")
]

# Views 12 degrees apart: fewer overlap, and the test views still lie between others.
TINY_DEMO = ("--views", "20", "--size", "200x150")
# Small enough for a full run in well under a minute, large enough to go through densification.
TINY = {
    "views": {"max_long_side_px": 200},
    "train": {"steps": 240, "density": {"max_gaussians": 6_000}},
}


def copy_project(target: Path) -> Path:
    """Copy the project's sources and their bytecode, without results, data and builds."""
    names = ("Snakefile", "pipeline", "stages", "profiles", "config", "pyproject.toml")
    target.mkdir(parents=True)
    for name in names:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, target / name)
        else:
            shutil.copy(source, target / name)
    return target


def make_scene(project: Path, scene: str, *options: str) -> None:
    """Make a tiny demo scene in ``data/<scene>`` of a project."""
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pipeline.demo",
            f"data/{scene}",
            *TINY_DEMO,
            *("--processes", "1"),  # starting more takes longer than they save
            *options,
        ],
        cwd=project,
        env=environment(project),
        check=True,
    )


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


def command(*args: str, config: dict | None = None, cores: int = 2) -> list[str]:
    line = [sys.executable, "-m", "snakemake", "--cores", str(cores), *args]
    if config is not None:
        line += ["--config", *(f"{name}={json.dumps(value)}" for name, value in config.items())]
    return line


def snakemake(
    project: Path, *args: str, config: dict | None = None, cores: int = 2, check: bool = True
) -> subprocess.CompletedProcess[str]:
    """Run Snakemake in ``project`` to its end; stdout and stderr together in ``stdout``.

    It and the jobs that need torch are forks of processes that have imported these packages:
    what ``start_and_kill`` and installed programs start is a new Python.
    """
    line = command(*args, config=config, cores=cores)
    with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
        code = RUNS.run(
            "snakemake",
            line[line.index("snakemake") + 1 :],
            folder=project,
            environment=environment(project),
            output=output.fileno(),
            timeout_s=900,
            python=JOBS.python(TORCH_JOBS),
        )
        output.seek(0)
        done = subprocess.CompletedProcess(line, code, output.read())
    if check and done.returncode != 0:
        raise AssertionError(f"snakemake ended with {done.returncode}:\n{done.stdout}")
    return done


def rules_run(done: subprocess.CompletedProcess[str], scene: str | None = None) -> set[str]:
    """Names of the rules of which jobs were started, for one scene or for all."""
    if scene is None:
        return set(re.findall(r"^(?:local)?rule (\w+):", done.stdout, re.M))
    jobs = re.findall(
        r"^(?:local)?rule (\w+):\n(?: .*\n)*? +wildcards: scene=(\S+)$", done.stdout, re.M
    )
    return {rule for rule, of in jobs if of == scene}


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
    process = subprocess.Popen(
        command(target, config=config, cores=cores),
        cwd=project,
        env=environment(project),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 300
    while not any(project.glob(ready)):
        assert process.poll() is None, f"snakemake ended before {ready} appeared"
        assert time.monotonic() < deadline, f"{ready} never appeared"
        time.sleep(0.01)
    if only_snakemake:
        process.kill()
    else:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def unlock(project: Path) -> None:
    """What ``snakemake --unlock`` does, in no time."""
    locks = list((project / ".snakemake" / "locks").iterdir())
    assert locks
    for lock in locks:
        lock.unlink()


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
