"""Which machine this is: what a time means nothing without."""

from __future__ import annotations

import os
import platform
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
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        load = round(os.getloadavg()[0], 2)
    except OSError:
        load = None
    return {
        "host": platform.node(),
        "platform": platform.platform(),
        "processor": named[0].partition(":")[2].strip() if named else platform.machine(),
        "cores": os.cpu_count(),
        "memory_mb": pages >> 20,
        "load_average": load,
    }
