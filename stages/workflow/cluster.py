"""The nodes of a Slurm cluster, its queue, and what it has granted to a job."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from pipeline.plan.values import Plan
from pipeline.runtime.native import MODULES

# Stages that are one submission of a scene, to save the time that each takes to start.
GROUPS: Mapping[str, Sequence[str]] = {
    "prepare": (
        *("inspect", "decode", "features", "pairs", "matches", "sfm"),
        *("refine", "undistort", "dense", "init"),
    ),
    "coarse": ("coarse", "partition"),
    "train": ("train", "holes", "export"),
    "finish": ("evaluate", "coverage", "report"),
}
# Cores that a stage asks for on a cluster whose nodes are unknown: few nodes have fewer.
DEFAULT_CPUS = 8
# Memory in MB that the two Snakemakes around a stage take in its job.
OVERHEAD_MB = 400
# Seconds between two looks at the queue.
QUEUE_SECONDS = 10.0
# Variables in jobs of Slurm, Grid Engine, PBS and LSF: the job's number and its number of cores.
_GRANTED = (
    ("SLURM_JOB_ID", "SLURM_CPUS_PER_TASK"),
    ("SLURM_JOB_ID", "SLURM_CPUS_ON_NODE"),
    ("JOB_ID", "NSLOTS"),
    ("PBS_JOBID", "NCPUS"),
    ("PBS_JOBID", "PBS_NUM_PPN"),
    ("LSB_JOBID", "LSB_DJOB_NUMPROC"),
)


@dataclass(frozen=True)
class Node:
    """The largest node that a job can get."""

    cpus: int
    memory_mb: int


def granted_cpus() -> int | None:
    """The number of cores of the cluster's job that this process is in; None outside of a job."""
    for job, cpus in _GRANTED:
        value = os.environ.get(cpus, "")
        if job in os.environ and value.isdecimal():
            return int(value)
    return None


def granted_memory_mb() -> int | None:
    """The memory of the Slurm job that this process is in; None outside of a job."""
    value = os.environ.get("SLURM_MEM_PER_NODE", "")
    return int(value) if value.isdecimal() and "SLURM_JOB_ID" in os.environ else None


def group_of(stage: str, plan: Plan) -> str | None:
    """Name of the group of jobs that the stage's job is submitted with; None: it is one by itself.

    A group is divided where jobs outside of it lie between its stages: otherwise it would depend on
    itself.
    """
    name = next((name for name, stages in GROUPS.items() if stage in stages), None)
    if name is None or plan.stages[stage].jobs > 1:
        return None
    divided = sum(plan.stages[source].jobs > 1 for source in _all_upstream(stage, plan))
    return f"{name}_{divided}" if divided else name


def _all_upstream(stage: str, plan: Plan) -> set[str]:
    """The stages that a stage depends on, directly or not."""
    found: set[str] = set()
    queue = [stage]
    while queue:
        for source in plan.stages[queue.pop()].inputs:
            if source not in found:
                found.add(source)
                queue.append(source)
    return found


@cache
def largest_node() -> Node | None:
    """The largest number of cores and memory of a node of the default partition, of all partitions
    if none is the default; None if Slurm does not answer."""
    command = ["sinfo", "-h", "-o", "%P %c %m"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    rows = [line.split() for line in done.stdout.splitlines()]
    rows = [row for row in rows if len(row) == 3]
    default = [row for row in rows if row[0].endswith("*")]
    # A "+" marks the least of several values.
    sizes = [(int(row[1].rstrip("+")), int(row[2].rstrip("+"))) for row in default or rows]
    return Node(max(c for c, _ in sizes), max(m for _, m in sizes)) if sizes else None


def wait_for_earlier_jobs(folder: Path) -> None:
    """Wait until no job of an earlier Snakemake in this folder is in the queue. Snakemake does not
    adopt the jobs of a killed one, and a second job for the same stage would hold its cores and
    memory while it waits for the first."""
    waiting = False
    while jobs := earlier_jobs(folder):
        if not waiting:
            waiting = True
            print(
                f"{folder}: Slurm's queue has jobs of an earlier run: {' '.join(jobs)}\n"
                "  this run submits its jobs when they have ended, and uses their results\n"
                f"  what to do: wait, or end them: scancel {' '.join(jobs)}",
                file=sys.stderr,
                flush=True,
            )
        time.sleep(QUEUE_SECONDS)


def earlier_jobs(folder: Path) -> Sequence[str]:
    """Ids of the jobs in the queue that a Snakemake in this folder has submitted; none if Slurm
    does not answer."""
    # Jobs import this module; Snakemake's modules are slow to import.
    from stages.workflow.internals import JOB_NAME

    command = ["squeue", "-h", "-o", "%i|%j|%Z"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    except (OSError, subprocess.SubprocessError):
        return []
    rows = [line.split("|", 2) for line in done.stdout.splitlines() if line.count("|") >= 2]
    here = os.path.realpath(folder)
    return [
        number
        for number, name, started_in in rows
        if JOB_NAME.fullmatch(name) and os.path.realpath(started_in) == here
    ]


def compile_for_all_nodes() -> None:
    """Compile the native libraries for every kind of processor that a node may have. Errors are
    left to the jobs."""
    for module in MODULES:
        command = [sys.executable, "-m", module, "--target", "all"]
        subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
