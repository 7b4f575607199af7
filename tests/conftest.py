"""For all tests."""

from __future__ import annotations

import os
from collections.abc import Generator

import pytest

from tests.tools import fail_skipped

# torch's own threads would spin beside the other worker's, and the references' arrays are small.
# Before torch is imported; the kernels' threads are given explicitly.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return fail_skipped((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return fail_skipped((yield))
