"""Every test of kernels runs on every backend; on the GPU's, with any Vulkan device, also one in
software (Debian: mesa-vulkan-drivers)."""

from __future__ import annotations

import pytest

from pipeline.render import Backend, make_backend
from tests.tools import need_gpu


@pytest.fixture(params=["cpu", "gpu"])
def backend(request: pytest.FixtureRequest) -> Backend:
    if request.param == "gpu":
        need_gpu()
    return make_backend(request.param)
