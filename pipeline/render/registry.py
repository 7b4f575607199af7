"""The backends by name, the default one, and the libraries that they compile. Importing this
module does not import torch."""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.render.backend import Backend
    from pipeline.runtime.native import NativeLibrary

BACKENDS = ("cpu", "gpu", "reference")
DEVICE = re.compile(r"cpu|gpu(:\d+)?")

_default = "cpu"


def use_device(device: str) -> None:
    """Make the backend of this device (see ``make_backend``) the default of the process."""
    global _default
    _default = device


def make_backend(name: str | None = None) -> Backend:
    """Return the backend of this name, one of ``BACKENDS`` or ``gpu:N`` for the GPU number N. The
    default is the processor's, unless ``use_device`` was called."""
    name = name or _default
    kind, _, number = name.partition(":")
    if name not in BACKENDS and not DEVICE.fullmatch(name):
        raise ValueError(f"no backend {name!r}; there are {', '.join(BACKENDS)}")
    return _backend(kind, int(number or 0))


@cache
def _backend(kind: str, number: int) -> Backend:
    # Explicit imports: the keys of stages are computed from imports.
    if kind == "cpu":
        from pipeline.render.cpu.backend import CpuBackend

        return CpuBackend()
    if kind == "gpu":
        from pipeline.render.gpu.backend import GpuBackend

        return GpuBackend(number)
    from pipeline.render.reference_backend import ReferenceBackend

    return ReferenceBackend()


def native_libraries() -> list[NativeLibrary]:
    """One library for each backend that is compiled, for tools that report on them or compile them
    beforehand.

    Raises:
        UserError: torch is not installed.
    """
    from pipeline.render.cpu import build

    return [build.library()]
