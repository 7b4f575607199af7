"""Differentiable rasterizer for 3D Gaussians: one interface with several backends.

``Backend`` (``backend.py``) is the interface: project, bin, blend, backward, loss, optimiser. The
default backend is ``cpu``: C++ kernels that are compiled at first use, or beforehand by
``python -m pipeline.render.cpu.build``. ``gpu`` has WGSL kernels, and ``reference`` is a readable
implementation in torch, float64. Importing this package does not import torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.render.registry import make_backend
from pipeline.render.types import (
    BACKGROUNDS,
    AdamRates,
    AlphaChangeLoss,
    CameraGradients,
    Color,
    Forward,
    FrameMoments,
    GaussianAdam,
    Gradients,
    ImageGradients,
    LossResult,
    Moments,
    RasterCamera,
    RasterOptions,
    ShAdam,
    Subset,
    Surroundings,
    ViewGradients,
)

if TYPE_CHECKING:
    from pipeline.render.backend import Backend

__all__ = [
    "BACKGROUNDS",
    "AdamRates",
    "AlphaChangeLoss",
    "Backend",
    "CameraGradients",
    "Color",
    "Forward",
    "FrameMoments",
    "GaussianAdam",
    "Gradients",
    "ImageGradients",
    "LossResult",
    "Moments",
    "RasterCamera",
    "RasterOptions",
    "ShAdam",
    "Subset",
    "Surroundings",
    "ViewGradients",
    "make_backend",
]


def __getattr__(name: str) -> Any:
    # The interface alone imports torch. An import statement, not a name in a string: the keys of
    # stages are computed from imports.
    if name == "Backend":
        from pipeline.render.backend import Backend

        return Backend
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
