"""Differentiable rasterizer for 3D Gaussians: one interface with several backends.

``Backend`` (``backend.py``) is the interface: project, bin, blend, backward, loss, optimiser. The
default backend is ``cpu``: C++ kernels that are compiled at first use, or beforehand by
``python -m pipeline.render.cpu.build``. ``reference`` is a readable implementation in torch,
float64. ``forward``, ``backward``, ``l1_ssim``, ``adam_step`` and ``frame_adam`` are operators of
``cpu``; ``render`` wraps the first two for autograd. Importing this package does not
import torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.render.types import (
    BACKGROUNDS,
    AlphaChangeLoss,
    CameraGradients,
    Color,
    DenseAdam,
    Forward,
    FrameAdam,
    Gradients,
    LossResult,
    RasterCamera,
    RasterOptions,
    RenderOutput,
    ShAdam,
    Subset,
    Surroundings,
)

if TYPE_CHECKING:
    from pipeline.render.backend import Backend
    from pipeline.render.operators import (
        adam_step,
        backward,
        forward,
        frame_adam,
        l1_ssim,
        render,
    )
    from pipeline.render.registry import make_backend

__all__ = [
    "BACKGROUNDS",
    "AlphaChangeLoss",
    "Backend",
    "CameraGradients",
    "Color",
    "DenseAdam",
    "Forward",
    "FrameAdam",
    "Gradients",
    "LossResult",
    "RasterCamera",
    "RasterOptions",
    "RenderOutput",
    "ShAdam",
    "Subset",
    "Surroundings",
    "adam_step",
    "backward",
    "forward",
    "frame_adam",
    "l1_ssim",
    "make_backend",
    "render",
]


def __getattr__(name: str) -> Any:
    # Import statements, not names in strings: the keys of stages are computed from imports.
    if name == "Backend":
        from pipeline.render.backend import Backend

        return Backend
    if name == "make_backend":
        from pipeline.render.registry import make_backend

        return make_backend
    if name in __all__:
        from pipeline.render import operators

        return getattr(operators, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
