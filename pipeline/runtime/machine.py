"""Which machine this is: what a time means nothing without."""

from __future__ import annotations

import os
import platform
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any


def processor() -> list[str]:
    """What the system says of its first core: model and instruction sets, a line each."""
    lines = [platform.machine(), platform.processor()]
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            for line in file:
                if not line.strip():
                    break  # one core speaks for all
                if line.startswith(("model name", "flags", "Features", "CPU part")):
                    lines.append(line.strip())
    except OSError:
        pass
    return lines


def machine_facts() -> dict[str, Any]:
    """Host, processor, logical cores, memory in MiB, and the load average of the last minute (1 is
    one busy core, this process among them; None where the system counts none)."""
    named = [line for line in processor() if line.startswith("model name")]
    try:
        load = round(os.getloadavg()[0], 2)
    except OSError:
        load = None
    return {
        "host": platform.node(),
        "platform": platform.platform(),
        "processor": named[0].partition(":")[2].strip() if named else platform.machine(),
        "cores": os.cpu_count(),
        "memory_mb": physical_memory() >> 20,
        "load_average": load,
    }


def physical_memory() -> int:
    """Bytes that the machine has."""
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
