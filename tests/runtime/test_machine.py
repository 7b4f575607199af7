"""How much memory there is, where a control group says less than the machine has."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.runtime import machine
from pipeline.runtime.machine import physical_memory, threads_within, usable_memory


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
    if group is not None:
        (tmp_path / "proc/self").mkdir(parents=True)
        (tmp_path / "proc/self/cgroup").write_text(group + "\n")
    for name, value in limits.items():
        path = tmp_path / "sys/fs/cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(value + "\n")
    assert usable_memory(tmp_path) == (physical_memory() if wanted is None else wanted)


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
