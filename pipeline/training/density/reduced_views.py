"""The training views at a reduced size, in which the geometry of the Gaussians is rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pipeline.render import Backend, RasterCamera, RasterOptions, make_backend


@dataclass(frozen=True)
class ReducedViews:
    """Renders of all training views without colours.

    Attributes:
        cameras: The cameras at the reduced size.
        options: The options of training, but with SH degree 0 and without a background.
        pixel: The number of pixels of a view in one pixel of the reduced size.
    """

    cameras: Sequence[RasterCamera]
    options: RasterOptions
    pixel: float = 1.0
    backend: Backend = field(default_factory=make_backend)
