"""For all tests."""

from __future__ import annotations

import os
from collections.abc import Generator, Iterator

import pytest
from hypothesis import HealthCheck, settings

from tests.tools import fail_skipped

# torch's own threads would spin beside the other worker's, and the references' arrays are small.
# Before torch is imported; the kernels' threads are given explicitly.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# No test fails because the machine is busy.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")


@pytest.fixture(autouse=True)
def environment() -> Iterator[None]:
    """Jobs and workflows in this process set variables, which other tests must not see."""
    before = dict(os.environ)
    yield
    for name in os.environ.keys() - before.keys():
        del os.environ[name]
    os.environ.update(before)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests first: pytest-xdist's workers begin with an equal part each and, at the end, take
    from one another what stands last."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0"))
    groups = [
        [item for item in items if bool(item.get_closest_marker("slow")) == slow]
        for slow in (True, False)
    ]
    if workers:
        items[:] = [
            item
            for worker in range(workers)
            for group in groups
            for item in group[len(group) * worker // workers : len(group) * (worker + 1) // workers]
        ]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return fail_skipped((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return fail_skipped((yield))
