"""Peak memory of this process."""

import resource
import sys


def peak_memory_mb() -> float:
    """Peak resident size in MiB, of this process or its largest finished child process."""
    usages = [resource.getrusage(kind) for kind in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    unit = 2**20 if sys.platform == "darwin" else 2**10  # ru_maxrss: bytes on macOS, KiB on Linux
    return max(usage.ru_maxrss for usage in usages) / unit
