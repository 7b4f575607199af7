"""Tests of kernels run on the backends with kernels, some tests on all backends; on the GPU's, with
any Vulkan device, also one in software (Debian: mesa-vulkan-drivers)."""

from __future__ import annotations

import pytest

from pipeline.render import Backend, make_backend
from pipeline.render.registry import BACKENDS
from tests.tools import need_gpu


def backend_of(request: pytest.FixtureRequest) -> Backend:
    if request.param == "gpu":
        need_gpu()
    return make_backend(request.param)


backend = pytest.fixture(params=["cpu", "gpu"], name="backend")(backend_of)
any_backend = pytest.fixture(params=BACKENDS, name="any_backend")(backend_of)
