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
import time
from collections import Counter
from pathlib import Path

from pipeline.demo.__main__ import main as write_demo

ROOT = Path(__file__).resolve().parents[2]

SOURCES = ("Snakefile", "pipeline", "stages", "profiles", "pyproject.toml")

# The views are 12 degrees apart: fewer overlap, and the test views still lie between others.
TINY_DEMO = ("--views", "20", "--size", "200x150")
# The run is short enough to take well under a minute, and goes through densification.
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
    words = [str(project / "data" / scene), *TINY_DEMO, "--processes", "1", *options]
    assert write_demo(words) == 0


def copy_run(source: Path, target: Path) -> Path:
    """Copy a project together with its results, keeping times, as if it had always been there."""
    subprocess.run(["cp", "-a", str(source), str(target)], check=True)
    return target


def environment(project: Path) -> dict[str, str]:
    return os.environ | {
        "PYTHONPATH": str(project),
        # The compiled extension is that of the project under test: its key follows its sources.
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


def start_snakemake(
    project: Path, *args: str, config: dict | None = None, cores: int = 2
) -> subprocess.Popen[bytes]:
    """Start Snakemake in ``project``, in a session of its own; its output is dropped."""
    return subprocess.Popen(
        command(*args, config=config, cores=cores),
        cwd=project,
        env=environment(project),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def snakemake(
    project: Path, *args: str, config: dict | None = None, cores: int = 2, check: bool = True
) -> subprocess.CompletedProcess[str]:
    """Run Snakemake in ``project`` to its end.

    Returns:
        The process: what it printed in ``stdout``, the logs that it wrote in ``stderr``.
    """
    before = time.time()
    done = subprocess.run(
        command(*args, config=config, cores=cores),
        cwd=project,
        env=environment(project),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=900,
    )
    logs = [*project.glob(".snakemake/log/*.log"), *project.glob("results/*/logs/*.log")]
    done.stderr = "".join(log.read_text() for log in logs if log.stat().st_mtime >= before)
    if check and done.returncode != 0:
        raise AssertionError(f"snakemake ended with {done.returncode}:\n{done.stdout}")
    return done


def rules_run(done: subprocess.CompletedProcess[str], scene: str | None = None) -> set[str]:
    """The names of the rules whose jobs were started, or would be, for one scene or for all."""
    planned = re.findall(r"^(\S+): would run (.*)$", done.stdout, re.M)
    jobs = [
        (re.sub(r"(_\d+)?( \(.*)?$", "", job), of) for of, all in planned for job in all.split(", ")
    ]
    jobs += re.findall(
        r"^(?:local)?rule (\w+):\n(?: .*\n)*? +wildcards: scene=([^\s,]+)", done.stderr, re.M
    )
    if scene is None:
        return {rule for rule, _ in jobs} | {
            *re.findall(r"^(?:local)?rule (\w+):", done.stderr, re.M)
        }
    return {rule for rule, of in jobs if of == scene}


def started(done: subprocess.CompletedProcess[str]) -> Counter[str]:
    """Rule -> number of its jobs that were started."""
    return Counter(re.findall(r"^(?:local)?rule (\w+):", done.stderr, re.M))


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
    run = start_snakemake(project, target, config=config, cores=cores)
    deadline = time.monotonic() + 300
    while not any(project.glob(ready)):
        assert run.poll() is None, f"snakemake ended before {ready} appeared"
        assert time.monotonic() < deadline, f"{ready} never appeared"
        time.sleep(0.01)
    if only_snakemake:
        os.kill(run.pid, signal.SIGKILL)
    else:
        os.killpg(run.pid, signal.SIGKILL)
    run.wait()


def metrics(project: Path, scene: str) -> dict:
    """The contents of ``metrics.json``, which are the same for the same work."""
    return json.loads((project / "results" / scene / "metrics.json").read_text())


def model_digests(project: Path, scene: str) -> dict[str, str]:
    """The digest of every file that makes up the result."""
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
