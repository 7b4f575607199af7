"""Renders of the views that are measured, beside their photographs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.config.schema import Train
from pipeline.metrics.flip import flip
from pipeline.metrics.image import psnr, ssim
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.protocol import Protocol
from pipeline.photos.load import load_view
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb, to_bytes
from pipeline.scene.appearance import Appearance, fitted_columns
from pipeline.scene.exposure import ExposureGains
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Rendered:
    """A render and its photograph.

    Attributes:
        view: The name of the view.
        rgb: (H, W, 3) float32.
        own: The same in the scene's own colours; None if the appearance was not fitted.
        photo: (H, W, 3) uint8.
        mask: (H, W), False for ignored pixels; None if there are none.
    """

    view: str
    rgb: NDArray[np.float32]
    own: NDArray[np.float32] | None
    photo: NDArray[np.uint8]
    mask: Mask | None

    @property
    def columns(self) -> slice:
        """The measured columns: the right half if the appearance was fitted on the left one."""
        return slice(0 if self.own is None else fitted_columns(self.photo.shape[1]), None)

    @property
    def measured_mask(self) -> Mask | None:
        return None if self.mask is None else self.mask[:, self.columns]

    @property
    def is_hidden(self) -> bool:
        """Whether the mask leaves no measured pixel."""
        return self.measured_mask is not None and not self.measured_mask.any()

    @property
    def is_masked(self) -> bool:
        """Whether the mask excludes at least one pixel that would be measured."""
        return self.measured_mask is not None and not self.measured_mask.all()

    def psnr(self, image: NDArray[np.uint8]) -> float:
        """PSNR of an image over the measured columns."""
        here = self.columns
        return psnr(image[:, here], self.photo[:, here], self.measured_mask)

    def ssim(self, image: NDArray[np.uint8]) -> float:
        """SSIM of an image over the measured columns."""
        here = self.columns
        return ssim(image[:, here], self.photo[:, here], self.measured_mask)

    def flip(self, image: NDArray[np.uint8]) -> float:
        """FLIP of an image over the measured columns."""
        here = self.columns
        return flip(image[:, here], self.photo[:, here], self.measured_mask)

    def distance(self, image: NDArray[np.uint8], lpips: Lpips) -> float:
        """LPIPS of an image over the measured columns."""
        here = self.columns
        return lpips(image[:, here], self.photo[:, here], self.measured_mask)


@dataclass(frozen=True)
class ViewRenderer:
    """Renders the views of a protocol as their photographs show them.

    Attributes:
        gains, appearance: See ``evaluate.evaluate_views``.
    """

    gaussians: Gaussians
    protocol: Protocol
    train: Train
    gains: ExposureGains
    appearance: Appearance | None
    threads: int

    def render(self, view: View) -> Rendered:
        """The render of a view, with its refined pose and its appearance."""
        pixels, options = load_view(view), self._options
        photo, shown, own = pixels.over(self.protocol.background), self.gaussians, None
        name, light = view.name, self.gains.of(view.name)
        if self.appearance is not None:
            from pipeline.training.appearance.fit import in_photograph

            shown = in_photograph(
                self.gaussians, self.appearance, view, photo, pixels.mask, options, light
            )
        if self.train.refine_poses and view.is_test:
            from pipeline.training.cameras.fit_pose import fit_pose

            extent, weight = self.protocol.extent, self.train.ssim_loss_weight
            view = fit_pose(shown, view, photo, pixels.mask, light, options, extent, weight)
        if name in self._fitted:
            own = render_rgb(self.gaussians, view, options)
        return Rendered(name, render_rgb(shown, view, options), own, photo, pixels.mask)

    def with_exposure(self, rgb: NDArray[np.float32], view: View) -> NDArray[np.uint8]:
        """A render (H, W, 3) of a view, multiplied by its light, with 8 bits."""
        light = self.gains.of(view.name)
        return to_bytes(rgb if light is None else rgb * light.factor(view))

    def smallest_side(self) -> int:
        """Of the measured parts of all views, pixels."""
        return min(
            min(
                view.height,
                view.width - (fitted_columns(view.width) if view.name in self._fitted else 0),
            )
            for view in self.protocol.views
        )

    @cached_property
    def _options(self) -> RasterOptions:
        return self.protocol.options(self.train, self.threads)

    @cached_property
    def _fitted(self) -> set[str]:
        """The views whose appearance is fitted."""
        if not self.appearance:
            return set()
        return {view.name for view in self.protocol.views} - self.appearance.embeddings.keys()
