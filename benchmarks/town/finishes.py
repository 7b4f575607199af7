"""What a face of a solid looks like, and the texture that is painted from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.town.noise import Floats, fractal

Colour = tuple[float, float, float]  # linear RGB albedo

TEXEL = 0.025  # metres
#: The coarsest structure of a texture, metres.
_COARSEST = 3.0
#: Rectangles of another brightness, for edges and corners: their number on a square metre, and the
#: largest side, metres.
_PATCHES, _LARGEST_PATCH = 0.8, 1.2


@dataclass(frozen=True)
class Finish:
    """The look of a face. Two faces with the same finish and size have the same picture."""

    seed: int
    colour: Colour


def painted(finish: Finish, width: float, height: float) -> Floats:
    """The linear albedo of a face of ``width`` times ``height`` metres, (rows, columns, 3), from
    its top left, in texels of ``TEXEL``: noise of all wavelengths, and rectangles."""
    rng = np.random.default_rng(finish.seed)
    rows, columns = (max(2, round(side / TEXEL)) for side in (height, width))
    brightness = 1 + np.float32(0.22) * fractal(rng, rows, columns, 1.0, _COARSEST / TEXEL)
    for _ in range(rng.poisson(_PATCHES * width * height)):
        row, column = rng.integers(rows), rng.integers(columns)
        down, right = (rng.uniform(0.1, _LARGEST_PATCH, 2) / TEXEL).astype(int)
        part = brightness[row : row + down, column : column + right]
        part *= np.float32(rng.uniform(0.4, 1.5))
    brightness = np.maximum(brightness, np.float32(0.2))
    return np.asarray(brightness[..., None] * np.array(finish.colour, np.float32))
