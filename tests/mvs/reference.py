"""Reference implementation of the matching cost in float64, pixel by pixel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.mvs.patchmatch import CostOptions, Picture, relative_projection

# Added to the variances, grey levels squared.
NOISE_VARIANCE = 1.0
MAX_COST, OUTSIDE_COST = 2.0, 0.5


def pixel_cost(
    reference: Picture,
    sources: Sequence[Picture],
    column: int,
    row: int,
    plane: tuple[float, float, float],
    options: CostOptions,
) -> float:
    """Cost of a plane at a pixel: the mean of the lowest costs of the sources.

    Args:
        plane: inverse depth at the pixel's centre and its gradient per pixel.
    """
    costs = [source_cost(reference, s, column, row, plane, options) for s in sources]
    return float(np.mean(sorted(costs)[: options.num_best]))


def source_cost(
    reference: Picture,
    source: Picture,
    column: int,
    row: int,
    plane: tuple[float, float, float],
    options: CostOptions,
) -> float:
    """1 - NCC of the window around a pixel and its image in a source.

    The plane induces a homography: with inverse depth w, pixel p is at K_s R K_r^-1 p + K_s t w.
    Weights are bilateral (Schönberger et al. 2016, equation 5).
    """
    rotation, translation = relative_projection(reference.view, source.view)
    height, width = reference.grey.shape

    def projected(dx: int, dy: int) -> NDArray[np.float64]:
        inverse_depth = plane[0] + dx * plane[1] + dy * plane[2]
        pixel = np.array([column + 0.5 + dx, row + 0.5 + dy, 1.0])
        return np.asarray(rotation @ pixel + translation * inverse_depth)

    centre = projected(0, 0)
    u, v = centre[:2] / centre[2]
    rows, columns = source.grey.shape
    if not (centre[2] > 0 and 0 <= u <= columns and 0 <= v <= rows):
        return OUTSIDE_COST
    weights, own, other = [], [], []
    for dy in range(-options.radius, options.radius + 1, 2):
        for dx in range(-options.radius, options.radius + 1, 2):
            x, y = column + dx, row + dy
            if not (0 <= x < width and 0 <= y < height and reference.valid[y, x]):
                continue
            change = float(reference.grey[y, x]) - float(reference.grey[row, column])
            exponent = change**2 / options.sigma_color**2 + (dx**2 + dy**2) / options.sigma_space**2
            weights.append(np.exp(-exponent / 2))
            own.append(float(reference.grey[y, x]))
            at = projected(dx, dy)
            other.append(interpolated(source.grey, *(at[:2] / at[2] - 0.5)))
    weight = np.array(weights) / max(sum(weights), 1e-12)
    a = np.array(own) - weight @ np.array(own)
    b = np.array(other) - weight @ np.array(other)
    scale = np.sqrt((weight @ a**2 + NOISE_VARIANCE) * (weight @ b**2 + NOISE_VARIANCE))
    return float(np.clip(1.0 - (weight @ (a * b)) / scale, 0.0, MAX_COST))


def interpolated(image: NDArray[np.uint8], x: float, y: float) -> float:
    """Bilinear interpolation at pixel indices; the border is continued."""
    height, width = image.shape
    x, y = float(np.clip(x, 0, width - 1)), float(np.clip(y, 0, height - 1))
    column, row = int(x), int(y)
    columns = [column, min(column + 1, width - 1)]
    rows = [row, min(row + 1, height - 1)]
    block = image[np.ix_(rows, columns)].astype(np.float64)
    across = block @ np.array([1 - (x - column), x - column])
    return float(across @ np.array([1 - (y - row), y - row]))
