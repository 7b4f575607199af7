"""Memory of this process."""

import ctypes
import mmap
import re
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_M_ARENA_MAX = -8  # malloc.h of glibc
_HUGE_PAGE = 2 << 20


def peak_memory_mb() -> float:
    """Peak resident size in MiB, of this process or its largest finished child process."""
    return max(_own_peak_mb(), _max_rss_mb(resource.RUSAGE_CHILDREN))


def _own_peak_mb() -> float:
    # On Linux, ru_maxrss is at least the size of the process that started this one.
    status = Path("/proc/self/status")
    if status.exists():
        found = re.search(r"^VmHWM:\s*(\d+) kB", status.read_text(), re.MULTILINE)
        if found:
            return int(found[1]) / 2**10
    return _max_rss_mb(resource.RUSAGE_SELF)


def _max_rss_mb(who: int) -> float:
    unit = 2**20 if sys.platform == "darwin" else 2**10  # ru_maxrss: bytes on macOS, KiB on Linux
    return resource.getrusage(who).ru_maxrss / unit


def release_free_memory() -> None:
    """Return freed memory to the system, which glibc keeps where allocations differ in size."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)


@contextmanager
def freed_memory() -> Iterator[None]:
    """Return memory that is freed before and inside the block to the system. Arrays of another size
    would leave gaps, and what the block leaves behind would stay beside the next large arrays."""
    release_free_memory()
    yield
    release_free_memory()


def huge_pages(size: int) -> mmap.mmap | None:
    """``size`` bytes outside the heap, in huge pages, of which a process takes fewer page faults.
    None if they are less than a huge page, or if the system has none."""
    if size < _HUGE_PAGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return None
    pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(OSError):  # The kernel was built without huge pages.
        pages.madvise(mmap.MADV_HUGEPAGE)
    return pages


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
