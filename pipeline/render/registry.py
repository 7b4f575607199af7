"""The backends by name."""

from __future__ import annotations

from functools import cache

from pipeline.render.backend import Backend

BACKENDS = ("cpu", "reference")


@cache
def make_backend(name: str = "cpu") -> Backend:
    """The backend of this name, one of ``BACKENDS``."""
    # Explicit imports: the keys of stages are computed from imports.
    if name == "cpu":
        from pipeline.render.cpu.backend import CpuBackend

        return CpuBackend()
    if name == "reference":
        from pipeline.render.reference_backend import ReferenceBackend

        return ReferenceBackend()
    raise ValueError(f"no backend {name!r}; there are {', '.join(BACKENDS)}")
