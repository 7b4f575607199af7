"""``python -m benchmarks.slurm``: the demo scene on a Slurm cluster that is started on this
machine (see ``benchmarks.slurm_cluster``): the time in which none of its jobs runs, and the time
that the training of blocks takes (``--blocks 4 --nodes 1 2``).
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.record_tables import slurm_table
from benchmarks.results import SlurmResult
from benchmarks.slurm_cluster import missing_programs, running
from pipeline.runtime.native import MODULES

ROOT = Path(__file__).parents[1]
TARGET = "results/demo/metrics.json"


def run(nodes: int, blocks: int, steps: int) -> SlurmResult:
    """Reconstruct the demo scene from its photographs."""
    project = Path(tempfile.mkdtemp(prefix="scene-"))
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))  # Paths of sockets must be short.
    try:
        for name in ("Snakefile", "pipeline", "stages", "profiles"):
            (project / name).symlink_to(ROOT / name)
        _python(project, "-m", "pipeline.demo", "data/demo")
        config = [f"train={json.dumps({'steps': steps})}"]
        config += [f"partition={json.dumps({'blocks': blocks})}"] if blocks > 1 else []
        with running(folder, nodes) as cluster:
            # Kernels are compiled before the clock starts, as on a cluster after its first scene.
            for module in MODULES:
                _python(project, "-m", module, "--target", "all")
            started = time.monotonic()
            options = ("--workflow-profile", "profiles/slurm", "--config", *config)
            _python(project, "-m", "snakemake", TARGET, *options)
            wall = time.monotonic() - started
            lines = cluster.run("squeue", "-h", "-t", "all", "-o", "%S|%e|%k").splitlines()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.rmtree(project, ignore_errors=True)
    jobs = [JobTimes.parse(line) for line in lines]
    for job in sorted(jobs):
        print(f"{job.end - job.start:6.0f} s  {job.rule}", file=sys.stderr)
    busy = covered([(job.start, job.end) for job in jobs])
    return SlurmResult("demo", nodes, blocks, len(jobs), wall, busy, blocks_span(jobs))


@dataclass(frozen=True, order=True)
class JobTimes:
    """The start and end of a job in seconds, and Snakemake's comment, which names its rule."""

    start: float
    end: float
    rule: str

    @classmethod
    def parse(cls, line: str) -> JobTimes:
        start, end, rule = line.split("|", 2)
        return cls(_seconds(start), _seconds(end), rule)


def blocks_span(jobs: Sequence[JobTimes]) -> float | None:
    """The seconds from the start of the first job of a block to the end of the last one."""
    found = [job for job in jobs if job.rule.startswith(("rule_block_", "rule_polish_"))]
    if not found:
        return None
    return max(job.end for job in found) - min(job.start for job in found)


def covered(intervals: Sequence[tuple[float, ...]]) -> float:
    """The length of the union of intervals."""
    total, end = 0.0, float("-inf")
    for first, last in sorted(intervals):
        total += max(0.0, last - max(first, end))
        end = max(end, last)
    return total


def _seconds(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _python(folder: Path, *arguments: str) -> None:
    cache = {"SPLATMAKE_CACHE": os.environ.get("SPLATMAKE_CACHE", str(ROOT / "build" / "native"))}
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | cache
    command = [sys.executable, *arguments]
    subprocess.run(command, cwd=folder, env=environment, stdout=sys.stderr, check=True)


def main() -> int:
    parser = argparse.ArgumentParser("python -m benchmarks.slurm", description=__doc__)
    parser.add_argument("--nodes", type=int, default=[2], nargs="+", help="with one core each")
    parser.add_argument("--blocks", type=int, default=1, help="of the scene")
    parser.add_argument("--steps", type=int, default=1500, help="of training")
    add_record_options(parser)
    options = parser.parse_args()
    if missing := missing_programs():
        parser.error(f"missing: {', '.join(missing)}")
    results = [run(nodes, options.blocks, options.steps) for nodes in options.nodes]
    print(slurm_table(results))
    if options.json:
        write_record(options.json, measured("slurm", options.note), results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
