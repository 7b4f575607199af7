"""Facts about the machine, and the cores and memory that this process may use."""

from __future__ import annotations

import os
import platform
import sys
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


def usable_cores() -> int:
    """The number of logical cores that this process may run on; batch systems and taskset can
    restrict it."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
    try:
        groups = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        groups = []
    for line in groups:
        _, controllers, path = line.split(":", 2)
        if not controllers:
            folder, name = root / "sys/fs/cgroup", "memory.max"
        elif "memory" in controllers.split(","):
            folder, name = root / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
        else:
            continue
        inside = PurePosixPath(path.lstrip("/"))
        for place in (inside, *inside.parents):
            with suppress(OSError, ValueError):  # missing, or "max"
                limits.append(int((folder / place / name).read_text()))
    return min(limits)
