"""The differentiable rasterizer for 3D Gaussians: one interface, several backends.

``Backend`` (``backend.py``) is the interface: project, bin, blend, backward, loss, optimiser. The
default is ``cpu``, kernels in C++ that are compiled at first use, or beforehand by
``python -m pipeline.render.cpu.build``; ``reference`` is the method in readable torch, float64.
``forward``, ``backward``, ``l1_ssim``, ``adam_step`` and ``frame_adam`` are the default's
operators; ``render`` wraps the first two in autograd. Importing this package imports no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.render.types import (
    CameraGradients,
    Forward,
    FrameAdam,
    Gradients,
    LossResult,
    RasterCamera,
    RasterOptions,
    RenderOutput,
    ShAdam,
)

if TYPE_CHECKING:
    from pipeline.render.backend import Backend, make_backend
    from pipeline.render.operators import (
        adam_step,
        backward,
        forward,
        frame_adam,
        l1_ssim,
        render,
    )

__all__ = [
    "Backend",
    "CameraGradients",
    "Forward",
    "FrameAdam",
    "Gradients",
    "LossResult",
    "RasterCamera",
    "RasterOptions",
    "RenderOutput",
    "ShAdam",
    "adam_step",
    "backward",
    "forward",
    "frame_adam",
    "l1_ssim",
    "make_backend",
    "render",
]


def __getattr__(name: str) -> Any:
    # Import statements rather than names in strings: stages' keys follow them to the code.
    if name in ("Backend", "make_backend"):
        from pipeline.render import backend

        return getattr(backend, name)
    if name in __all__:
        from pipeline.render import operators

        return getattr(operators, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
