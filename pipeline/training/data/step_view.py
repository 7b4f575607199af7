"""The view of a training step."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.render import Color, RasterCamera
from pipeline.scene.views import View
from pipeline.training.data.targets import Target


@dataclass(frozen=True)
class StepView:
    """The view that a step renders, at 1 / ``factor`` of its size.

    Attributes:
        index: The view's place among the training views.
        full: The view at its full size.
        target: The pixels.
        camera: The refined camera.
        background: The colour behind the Gaussians.
    """

    index: int
    factor: int
    full: View
    target: Target
    camera: RasterCamera
    background: Color
