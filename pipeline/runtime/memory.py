"""How much memory this process has needed."""

import resource
import sys


def peak_memory_mb() -> float:
    """The largest resident size so far, of this process or of its largest finished child, MiB."""
    usages = [resource.getrusage(kind) for kind in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    unit = 2**20 if sys.platform == "darwin" else 2**10  # ru_maxrss: bytes on macOS, KiB on Linux
    return max(usage.ru_maxrss for usage in usages) / unit
