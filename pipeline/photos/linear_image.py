"""Conversion of images of linear light to the 8-bit sRGB or 16-bit linear values that later stages
read."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.config.schema import Decode
from pipeline.io import exr
from pipeline.io.colour import srgb_curve
from pipeline.io.recorded import read_recorded
from pipeline.scene.manifest import Photo


@dataclass(frozen=True)
class Developed:
    """A developed photograph.

    Attributes:
        rgb: (H, W, 3) uint8 sRGB or uint16 linear, straight (not multiplied by alpha).
        alpha: (H, W) of the same dtype, or None if all pixels are opaque.
    """

    rgb: NDArray[Any]
    alpha: NDArray[Any] | None = None


def develop_exr(photo: Photo, config: Decode) -> Developed:
    """Develop an EXR file: 0 is black and 1 is white in all photographs, with the primaries of
    sRGB; values outside are clipped.

    Raises:
        ValueError: The file is not a readable image.
    """
    rgb, alpha = exr.read_pixels(io.BytesIO(read_recorded(photo.path, photo.digest)))
    rgb = np.nan_to_num(rgb, nan=0.0, posinf=1.0, neginf=0.0)
    if alpha is not None:
        alpha = np.nan_to_num(alpha, nan=0.0).clip(0, 1)
        # EXR colours are multiplied by alpha (OpenEXR, "Technical Introduction").
        rgb = np.where(alpha[..., None] > 0, rgb / np.maximum(alpha, 1e-6)[..., None], 0)
    rgb = rgb.clip(0, 1)
    depth = np.uint16 if config.linear else np.uint8
    values = _quantized(rgb if config.linear else srgb_curve(rgb), depth)
    opaque = alpha is None or bool((alpha >= 1).all())
    return Developed(values, None if opaque or alpha is None else _quantized(alpha, depth))


def _quantized(values: NDArray[np.float32], depth: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    return np.rint(values * np.iinfo(depth).max).astype(depth)
