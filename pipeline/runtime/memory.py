"""Memory of this process."""

import ctypes
import resource
import sys
from pathlib import Path

_M_ARENA_MAX = -8  # malloc.h of glibc


def peak_memory_mb() -> float:
    """Peak resident size in MiB, of this process or its largest finished child process."""
    usages = [resource.getrusage(kind) for kind in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    unit = 2**20 if sys.platform == "darwin" else 2**10  # ru_maxrss: bytes on macOS, KiB on Linux
    return max(usage.ru_maxrss for usage in usages) / unit


def release_free_memory() -> None:
    """Return freed memory to the system, which glibc keeps where allocations differ in size."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)


def share_heap() -> None:
    """Let all threads allocate from one heap, before they start: otherwise glibc keeps what each of
    them has freed for itself."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(_M_ARENA_MAX, 1)


def limit_address_space(size: int) -> None:
    """Let allocations beyond ``size`` bytes more than now fail in this process (Linux)."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        return
    used = int(statm.read_text().split()[0]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    wanted = used + size if hard == resource.RLIM_INFINITY else min(used + size, hard)
    resource.setrlimit(resource.RLIMIT_AS, (wanted, hard))
