"""For all tests."""

from __future__ import annotations

import os
from collections.abc import Generator

import pytest

from tests.tools import fail_skipped

# torch's own threads would spin beside the other worker's, and the references' arrays are small.
# Before torch is imported; the kernels' threads are given explicitly.
os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests first: pytest-xdist's two workers begin with a half each and, at the end, take
    from one another what stands last."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    slow = [item for item in items if item.get_closest_marker("slow")]
    fast = [item for item in items if not item.get_closest_marker("slow")]
    middle, half = len(slow) // 2, len(fast) // 2
    items[:] = slow[:middle] + fast[:half] + slow[middle:] + fast[half:]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return fail_skipped((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return fail_skipped((yield))
