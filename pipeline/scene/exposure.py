"""Exposure and shading of the views (``exposure.json``): the factors by which renders are
multiplied before they are compared with photographs."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, RootModel

from pipeline.runtime.json_file import JsonFile, JsonObject, Vector3, mismatch
from pipeline.scene.views import View

Vector2 = tuple[float, float]
#: Planes of vignetting that are kept in memory: those of the cameras in use.
KEPT_PLANES = 8


class ViewLight(JsonObject):
    """The factor from the scene's display values to a photograph's.

    At the image position (x, y), relative to the principal point and in half diagonals of the
    whole image, the factor of channel c is gain_c * 2^(v1 r^2 + v2 r^4 + s1 x + s2 y), with
    r^2 = x^2 + y^2.
    """

    gain: Vector3 = Field(
        description="RGB factors at the principal point, relative to the scene's typical exposure."
    )
    vignetting: Vector2 = Field(
        (0.0, 0.0),
        description="`v1` and `v2`, log2 of display values; the same for all photographs of a "
        "camera.",
    )
    slope: Vector2 = Field(
        (0.0, 0.0),
        description="`s1` and `s2`, log2 of display values per half diagonal, right and down.",
    )

    @property
    def is_uniform(self) -> bool:
        """Whether the factor is the same in the whole image."""
        return not any(self.vignetting) and not any(self.slope)

    def factor(self, view: View, size: tuple[int, int] | None = None) -> NDArray[np.float32]:
        """The factors of a view's pixels: (3,) if the light is uniform, else (H, W, 3).

        Args:
            size: The width and height of the pixel grid over the view; None: those of the view.
        """
        gain = np.array(self.gain, np.float32)
        if self.is_uniform:
            return gain
        width, height = size or (view.width, view.height)
        x, y = image_positions(view, width, height)
        plane = np.exp2(self.slope[1] * y)[:, None] * np.exp2(self.slope[0] * x)
        plane = plane.astype(np.float32)
        if any(self.vignetting):
            plane *= _vignetting_plane(self.vignetting, tuple(x), tuple(y))
        # One channel at a time: numpy is slow where the last axis has only three entries.
        factors = np.empty((height, width, 3), np.float32)
        for channel in range(3):
            np.multiply(plane, gain[channel], out=factors[..., channel])
        return factors


def image_positions(
    view: View, width: int, height: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(width,) x and (height,) y of the columns and rows of a pixel grid over a view, relative to
    the principal point, in half diagonals of the whole image."""
    unit = half_diagonal(view)
    x = (np.arange(width, dtype=np.float64) + 0.5) * (view.width / width) - view.cx
    y = (np.arange(height, dtype=np.float64) + 0.5) * (view.height / height) - view.cy
    return x / unit, y / unit


def half_diagonal(view: View) -> float:
    """Half the diagonal of the whole image that the view shows a part of, pixels of the view."""
    crop = view.crop
    size = (view.width, view.height) if crop is None else (crop.full_width, crop.full_height)
    return float(np.hypot(*size)) / 2


@lru_cache(KEPT_PLANES)
def _vignetting_plane(
    vignetting: Vector2, x: tuple[float, ...], y: tuple[float, ...]
) -> NDArray[np.float32]:
    """(H, W) 2^(v1 r^2 + v2 r^4). Callers must not change it."""
    squared = np.square(y)[:, None] + np.square(x)
    return np.exp2(squared * (vignetting[0] + vignetting[1] * squared)).astype(np.float32)


class ExposureGains(JsonFile, RootModel[dict[str, ViewLight]]):
    """The factors from the scene's typical light to each view's, for display values, by name of the
    view; empty if exposure is not modelled."""

    file_name: ClassVar[str] = "exposure.json"

    def __bool__(self) -> bool:
        return bool(self.root)

    def of(self, view: str) -> ViewLight | None:
        """The factor of a view; None if exposure is not modelled."""
        return self.root[view] if self.root else None

    def of_all(self, views: Iterable[str]) -> list[ViewLight] | None:
        """The factors of views in order; None if exposure is not modelled."""
        return [self.root[view] for view in views] if self.root else None

    @classmethod
    def read_for(cls, folder: Path, views: Iterable[str]) -> Self:
        """Read the factors of these views.

        Raises:
            UserError: the file is missing or damaged, or lacks one of the views.
        """
        gains, names = cls.read(folder), set(views)
        missing = sorted(names - gains.root.keys()) if gains else []
        if missing:
            raise mismatch(
                folder / cls.file_name,
                f"expected the gains of {len(names)} views, found none for {missing[0]}",
            )
        return gains


NO_GAINS = ExposureGains({})
