"""The differentiable rasterizer for 3D Gaussians: C++ kernels, and a float64 reference.

``forward``, ``backward``, ``l1_ssim``, ``adam_step`` and ``frame_adam`` are what a trainer calls;
``render`` wraps the first two in autograd. The kernels are compiled at first use, or beforehand by
``python -m pipeline.render.cpu.build``. ``pipeline.render.reference`` holds the method in
readable torch. Importing this package imports no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from pipeline.render.types import (
    CameraGradients,
    FrameAdam,
    Gradients,
    LossResult,
    RasterCamera,
    RasterOptions,
    RenderOutput,
    ShAdam,
)

if TYPE_CHECKING:
    from pipeline.render.cpu.ops import (
        Forward,
        adam_step,
        backward,
        forward,
        frame_adam,
        l1_ssim,
        render,
    )

__all__ = [
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
    "render",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(importlib.import_module("pipeline.render.cpu.ops"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
