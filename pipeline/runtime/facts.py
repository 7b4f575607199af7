"""The record of a stage's run (``run.json``)."""

from __future__ import annotations

import platform
import resource
import subprocess
import time
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pipeline.runtime.layout import IS_CHECKOUT, PACKAGES
from pipeline.runtime.machine import machine_facts
from pipeline.runtime.memory import peak_memory_mb
from pipeline.runtime.native import native_facts
from pipeline.runtime.record import RunRecord


def run_record(
    wall: float, *, threads: int, seed: int | None, timings: Mapping[str, Any]
) -> RunRecord:
    """The record of a run of ``wall`` seconds: time, memory, versions, commit, machine, instruction
    set, and the stage's ``timings``."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    facts = {
        "wall_s": round(wall, 3),
        "cpu_s": round(sum(u.ru_utime + u.ru_stime for u in (own, children)), 3),
        "peak_rss_mb": round(peak_memory_mb(), 1),
        "threads": threads,
        "seed": seed,
        **machine_facts(),
        **native_facts(),
        "versions": versions(),
        "commit": commit(),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        **timings,
    }
    return RunRecord.model_validate(facts)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that affect results."""
    found = {"python": platform.python_version()}
    for name in (
        "torch",
        "pycolmap",
        "opencv-contrib-python-headless",
        "numpy",
        "scipy",
        "rawpy",
        "snakemake",
        # A checkout is identified by its commit instead.
        *(() if IS_CHECKOUT else ("splatmake",)),
    ):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found


def commit() -> str | None:
    """The checkout's commit. An installed package may be inside another repository, hence None."""
    if not IS_CHECKOUT:
        return None
    git = ["git", "-C", str(PACKAGES), "rev-parse", "HEAD"]
    try:
        done = subprocess.run(git, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None
