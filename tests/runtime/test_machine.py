"""Memory and cores of a process whose control groups have less than the machine."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.runtime import machine
from pipeline.runtime.machine import (
    physical_memory,
    threads_within,
    usable_cores,
    usable_memory,
)


def write_groups(root: Path, group: str | None, limits: dict[str, str]) -> None:
    """Write the control group of the process, and files of control groups."""
    if group is not None:
        (root / "proc/self").mkdir(parents=True)
        (root / "proc/self/cgroup").write_text(group + "\n")
    for name, value in limits.items():
        path = root / "sys/fs/cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(value + "\n")


@pytest.mark.parametrize(
    ("group", "limits", "wanted"),
    [
        ("0::/", {"memory.max": "700000000"}, 700_000_000),
        # A batch job: its step sets nothing, the job does, the machine's own group more.
        (
            "0::/slurm/job_7/step_0",
            {
                "slurm/job_7/step_0/memory.max": "max",
                "slurm/job_7/memory.max": "300000000",
                "slurm/memory.max": "900000000",
            },
            300_000_000,
        ),
        # Version 1, where no limit is a number beyond any memory.
        (
            "5:cpu,cpuacct:/\n4:memory:/docker/a",
            {
                "memory/docker/a/memory.limit_in_bytes": "500000000",
                "memory/memory.limit_in_bytes": "9223372036854771712",
            },
            500_000_000,
        ),
        ("0::/elsewhere", {}, None),
        (None, {}, None),
    ],
)
def test_the_least_limit_counts(
    tmp_path: Path, group: str | None, limits: dict[str, str], wanted: int | None
) -> None:
    write_groups(tmp_path, group, limits)
    assert usable_memory(tmp_path) == (physical_memory() if wanted is None else wanted)


@pytest.mark.parametrize(
    ("group", "limits", "wanted"),
    [
        ("0::/", {"cpu.max": "350000 100000"}, 3),
        ("0::/", {"cpu.max": "max 100000"}, 8),
        ("0::/", {"cpu.max": "50000 100000"}, 1),
        ("0::/job/step", {"job/step/cpu.max": "max 100000", "job/cpu.max": "200000 100000"}, 2),
        (
            "3:cpu,cpuacct:/docker/a",
            {"cpu/docker/a/cpu.cfs_quota_us": "400000", "cpu/docker/a/cpu.cfs_period_us": "100000"},
            4,
        ),
        ("3:cpu:/", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 8),
        ("0::/", {"cpu.max": "what is this"}, 8),
    ],
)
def test_a_limit_of_processor_time_limits_the_cores(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    group: str,
    limits: dict[str, str],
    wanted: int,
) -> None:
    monkeypatch.setattr(machine.os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    write_groups(tmp_path, group, limits)
    assert usable_cores(tmp_path) == wanted


@pytest.mark.parametrize(
    ("threads", "each", "kept", "expected"),
    [
        (8, 1e9, 0, 4),
        (2, 1e9, 0, 2),
        (8, 1e9, 2e9, 2),
        (8, 9e9, 0, 1),
        (8, 1, 9e9, 1),
        (0, 0, 0, 1),
    ],
)
def test_half_of_the_memory_limits_the_threads(monkeypatch, threads, each, kept, expected):
    monkeypatch.setattr(machine, "usable_memory", lambda: 8_000_000_000)
    assert threads_within(threads, each, kept) == expected
