"""Which machine this is, and what of it this process may use: cores and memory."""

from __future__ import annotations

import os
import platform
import sys
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from pipeline.runtime.processor import processor_name, sysctl_value


def machine_facts() -> dict[str, Any]:
    """Host, processor, logical cores, memory in MiB, and the load average of the last minute (1 is
    one busy core, this process among them; None where the system counts none)."""
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
    """Logical cores that this process may run on; a batch system or taskset may allow fewer than
    there are."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def physical_memory() -> int:
    """Bytes that the machine has."""
    if sys.platform == "darwin":
        return int(sysctl_value("hw.memsize"))
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def usable_memory(root: Path = Path("/")) -> int:
    """Bytes that this process may use: the machine's, or less where a container, a batch system or
    a service manager sets a limit (Linux control groups, versions 1 and 2, and their parents).

    Args:
        root: where /proc and /sys are.
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
            with suppress(OSError, ValueError):  # not there, or "max"
                limits.append(int((folder / place / name).read_text()))
    return min(limits)
