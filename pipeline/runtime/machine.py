"""Facts about the machine, and the cores and memory that this process may use."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from pipeline.runtime.processor import processor_name, sysctl_value

# The share of the memory that threads with large pictures use; the rest is left to other programs.
_THREADS_SHARE = 0.5


def machine_facts() -> dict[str, Any]:
    """Host, processor, logical cores, memory in MiB, and the load average of the last minute (None
    if the system does not provide it)."""
    try:
        load = round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        load = None
    return {
        "host": platform.node(),
        "platform": platform.platform(),
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "memory_mb": physical_memory() >> 20,
        "load_average": load,
    }


def usable_cores(root: Path = Path("/")) -> int:
    """The number of processor cores that this process may use. The threads of one core count once:
    the kernels fill its units with one. Batch systems and taskset restrict the cores, and so do the
    limits of a Linux control group, such as a container's ``--cpus``.

    Args:
        root: The folder of /proc and /sys.
    """
    if not hasattr(os, "sched_getaffinity"):  # macOS
        return os.cpu_count() or 1
    cores = {_threads_of_core(cpu, root) for cpu in os.sched_getaffinity(0)}
    quotas = [int(quota) for quota in _cpu_quotas(root)]
    return max(1, min([len(cores), *quotas]))


def _threads_of_core(cpu: int, root: Path) -> str:
    """The logical processors of the core of one of them, such as "0,4"."""
    try:
        topology = root / f"sys/devices/system/cpu/cpu{cpu}/topology"
        return (topology / "thread_siblings_list").read_text()
    except OSError:
        return str(cpu)


def _cpu_quotas(root: Path) -> Iterator[float]:
    """The processors' time over wall time that this process's control groups allow."""
    for folder in _control_groups("cpu", root):
        with suppress(OSError, ValueError):  # missing, or "max"
            quota, period = (folder / "cpu.max").read_text().split()
            yield int(quota) / int(period)
        with suppress(OSError, ValueError):
            limit = int((folder / "cpu.cfs_quota_us").read_text())
            if limit > 0:  # -1: no limit
                yield limit / int((folder / "cpu.cfs_period_us").read_text())


def physical_memory() -> int:
    """The machine's memory in bytes."""
    if sys.platform == "darwin":
        return int(sysctl_value("hw.memsize"))
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def threads_within(threads: int, bytes_each: float, kept: float = 0.0) -> int:
    """The number of threads, at most ``threads``, that a part of the memory is enough for.

    Args:
        bytes_each: The bytes that each thread needs.
        kept: The bytes that all threads need together.
    """
    available = _THREADS_SHARE * usable_memory() - kept
    return max(1, min(threads, int(available / max(bytes_each, 1.0))))


def usable_memory(root: Path = Path("/")) -> int:
    """The memory in bytes that this process may use: the machine's, or the limit of a Linux control
    group (version 1 or 2, or a parent) set by a container, batch system or service manager.

    Args:
        root: The folder of /proc and /sys.
    """
    limits = [physical_memory()]
    for folder in _control_groups("memory", root):
        for name in ("memory.max", "memory.limit_in_bytes"):
            with suppress(OSError, ValueError):  # missing, or "max"
                limits.append(int((folder / name).read_text()))
    return min(limits)


def _control_groups(controller: str, root: Path) -> Iterator[Path]:
    """The folders of this process's Linux control groups of a controller and of their parents,
    version 1 or 2."""
    try:
        groups = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in groups:
        _, controllers, path = line.split(":", 2)
        if not controllers:
            folder = root / "sys/fs/cgroup"
        elif controller in controllers.split(","):
            folder = root / "sys/fs/cgroup" / controller
        else:
            continue
        inside = PurePosixPath(path.lstrip("/"))
        yield from (folder / place for place in (inside, *inside.parents))
