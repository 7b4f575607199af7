"""The backends by name."""

from __future__ import annotations

from functools import cache

from pipeline.render.backend import Backend

BACKENDS = ("cpu", "gpu", "reference")


def make_backend(name: str = "cpu") -> Backend:
    """The backend of this name, one of ``BACKENDS``; ``gpu:N`` is another GPU than the first."""
    kind, _, number = name.partition(":")
    if kind not in BACKENDS or (number and not (kind == "gpu" and number.isdecimal())):
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
