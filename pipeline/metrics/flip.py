"""LDR-FLIP: the difference that a viewer notices when two images alternate on a screen.

Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström and Fairchild, "FLIP: A Difference Evaluator
for Alternating Images" (2020), with the constants of the authors' program.

Images are (H, W, 3) sRGB: floats in [0, 1], or uint8 where 255 represents 1.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.metrics.image import as_float64, bands, checked_mask

PIXELS_PER_DEGREE = 3840 * np.pi / 180
"""Pixels per degree of visual angle, 67.02, the authors' default: a display of 3840 pixels that is
as wide as it is far away."""

FLIP_VARIANT = f"LDR-FLIP, {PIXELS_PER_DEGREE:.0f} pixels per degree, mean over pixels"

Array = NDArray[np.float64]

# Linear sRGB to CIE XYZ of D65, divided by its white point (each row then sums to 1).
_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
_TO_XYZ /= _TO_XYZ.sum(axis=1, keepdims=True)
# XYZ to the opponent colours Y, Cx (red-green), Cz (blue-yellow), without their constant offset:
# blurs keep a constant, and edges do not see it.
_OPPONENT = np.array([[0.0, 116.0, 0.0], [500.0, -500.0, 0.0], [0.0, 200.0, -200.0]])
_TO_OPPONENT = _OPPONENT @ _TO_XYZ
_TO_LINEAR = np.linalg.inv(_TO_OPPONENT)

# Contrast sensitivity of the opponent channels: sums of Gaussians, each with its weight and its
# width in squared degrees.
_SENSITIVITY = (
    ((1.0, 0.0047),),
    ((1.0, 0.0053),),
    ((34.1, 0.04), (13.5, 0.025)),
)
# Exponent of the colour difference; those up to 0.4 of the largest are mapped to [0, 0.95].
_COLOR_POWER, _KNEE, _AT_KNEE = 0.7, 0.4, 0.95
# Width of the feature detectors, degrees.
_FEATURE_WIDTH = 0.082


def flip(image: NDArray[Any], reference: NDArray[Any], mask: NDArray[Any] | None = None) -> float:
    """Mean FLIP error over the unmasked pixels: 0 for identical images, at most 1.

    Args:
        image, reference: (H, W, 3).
        mask: (H, W) or None. Masked (zero) pixels of the image are replaced by the reference's,
            so that they do not affect their neighbours, and are excluded from the mean.

    Raises:
        UserError: No pixel is unmasked.
    """
    keep = checked_mask(image, reference, mask)
    errors = np.empty(image.shape[:2])
    for rows in bands(image):
        # The filters of the band's pixels reach beyond it.
        first = max(rows.start - _REACH, 0)
        reached = slice(first, rows.stop + _REACH)
        x, y = _opponent(image[reached]), _opponent(reference[reached])
        if keep is not None:
            x = np.where(keep[reached, :, None], x, y)
        inner = slice(rows.start - first, rows.stop - first)
        errors[rows] = _color_error(x, y, inner) ** (1.0 - _feature_error(x, y, inner))
    return float(np.mean(errors if keep is None else errors[keep]))


def _opponent(image: NDArray[Any]) -> Array:
    """Opponent colours (H, W, 3)."""
    if image.dtype == np.uint8:
        return np.asarray(cv2.transform(_linear(np.arange(256) / 255.0)[image], _TO_OPPONENT))
    return np.asarray(cv2.transform(_linear(as_float64(image)), _TO_OPPONENT))


def _linear(srgb: Array) -> Array:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _color_error(x: Array, y: Array, rows: slice) -> Array:
    """Difference of the colours that remain at the viewing distance, in [0, 1]."""
    a, b = (_hunt_lab(_seen(picture)[rows]) for picture in (x, y))
    power = _hyab(a, b) ** _COLOR_POWER
    knee = _KNEE * _LARGEST
    beyond = _AT_KNEE + (power - knee) / (_LARGEST - knee) * (1.0 - _AT_KNEE)
    return np.where(power < knee, _AT_KNEE / knee * power, beyond)


def _seen(opponent: Array) -> Array:
    """Linear sRGB in [0, 1] after the filters of contrast sensitivity."""
    channels = [
        sum(_separable(opponent[..., channel], kernel, kernel) * weight for weight, kernel in terms)
        for channel, terms in enumerate(_SPATIAL)
    ]
    return np.clip(cv2.transform(np.stack(channels, axis=-1), _TO_LINEAR), 0.0, 1.0)


def _hunt_lab(linear: Array) -> Array:
    """CIE L*a*b* with Hunt's adjustment: dark colours appear less saturated."""
    xyz = np.asarray(cv2.transform(linear, _TO_XYZ))
    delta = 6 / 29
    f = np.where(xyz > delta**3, np.cbrt(xyz), xyz / (3 * delta**2) + 4 / 29)
    lightness = 116.0 * f[..., 1] - 16.0
    a, b = 500.0 * (f[..., 0] - f[..., 1]), 200.0 * (f[..., 1] - f[..., 2])
    return np.stack([lightness, 0.01 * lightness * a, 0.01 * lightness * b], axis=-1)


def _hyab(a: Array, b: Array) -> Array:
    """HyAB distance, which is meant for large differences of colours."""
    difference = a - b
    return np.abs(difference[..., 0]) + _length(difference[..., 1], difference[..., 2])


def _feature_error(x: Array, y: Array, rows: slice) -> Array:
    """Difference of edges and points of the lightness, in [0, 1]."""
    blur, edge, point = _FEATURES
    strongest = np.zeros(x[rows].shape[:2])
    for detector in (edge, point):
        lengths = [
            _length(_separable(plane, detector, blur), _separable(plane, blur, detector))[rows]
            for plane in (x[..., 0] / 116.0, y[..., 0] / 116.0)
        ]
        strongest = np.maximum(strongest, np.abs(lengths[0] - lengths[1]))
    return np.sqrt(np.minimum(strongest / np.sqrt(2.0), 1.0))


def _length(x: Array, y: Array) -> Array:
    return np.sqrt(x * x + y * y)


def _separable(values: Array, along_x: Array, along_y: Array) -> Array:
    """Correlation with the product of two kernels; pixels of the border are repeated outside."""
    values = np.ascontiguousarray(values)
    found = cv2.sepFilter2D(values, -1, along_x, along_y, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float64).reshape(values.shape)


def _spatial_kernels() -> list[list[tuple[float, Array]]]:
    """Of each channel, the weights and the one-dimensional kernels of its Gaussians; the weights
    of a channel sum to 1."""
    widest = max(width for terms in _SENSITIVITY for _, width in terms)
    radius = int(np.ceil(3.0 * np.sqrt(widest / (2.0 * np.pi**2)) * PIXELS_PER_DEGREE))
    degrees = np.arange(-radius, radius + 1) / PIXELS_PER_DEGREE
    found = []
    for terms in _SENSITIVITY:
        kernels = [np.exp(-(np.pi**2) * degrees**2 / width) for _, width in terms]
        weights = [
            amplitude * np.sqrt(np.pi / width) * kernel.sum() ** 2
            for (amplitude, width), kernel in zip(terms, kernels, strict=True)
        ]
        found.append(
            [
                (float(weight / sum(weights)), kernel / kernel.sum())
                for weight, kernel in zip(weights, kernels, strict=True)
            ]
        )
    return found


def _feature_kernels() -> tuple[Array, Array, Array]:
    """A Gaussian, and its first and second derivative with positive and negative weights that sum
    to 1 and -1."""
    deviation = 0.5 * _FEATURE_WIDTH * PIXELS_PER_DEGREE
    radius = int(np.ceil(3.0 * deviation))
    x = np.arange(-radius, radius + 1.0)
    gauss = np.exp(-(x**2) / (2.0 * deviation**2))

    def balanced(kernel: Array) -> Array:
        positive, negative = np.maximum(kernel, 0.0), np.maximum(-kernel, 0.0)
        return positive / positive.sum() - negative / negative.sum()

    return gauss / gauss.sum(), balanced(-x * gauss), balanced((x**2 / deviation**2 - 1) * gauss)


_SPATIAL = _spatial_kernels()
_FEATURES = _feature_kernels()
_REACH = max(len(_SPATIAL[0][0][1]), len(_FEATURES[0])) // 2
# The largest difference of colours of sRGB, which is between green and blue.
_LARGEST = float(
    _hyab(
        *(_hunt_lab(np.array(color)[None, None]) for color in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    ).item()
    ** _COLOR_POWER
)
