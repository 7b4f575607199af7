"""The nodes of a Slurm cluster, and what it has granted to a job."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from functools import cache

# Cores that a stage asks for on a cluster whose nodes are unknown: few nodes have fewer.
DEFAULT_CPUS = 8
# Memory in MB that the two Snakemakes around a stage take in its job.
OVERHEAD_MB = 400


@dataclass(frozen=True)
class Node:
    """The largest node that a job can get."""

    cpus: int
    memory_mb: int


def granted_cpus() -> int | None:
    """The number of cores of the Slurm job that this process is in; None outside of a job."""
    value = os.environ.get("SLURM_CPUS_PER_TASK") or os.environ.get("SLURM_CPUS_ON_NODE", "")
    return int(value) if value.isdecimal() and "SLURM_JOB_ID" in os.environ else None


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
