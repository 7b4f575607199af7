"""Image quality: PSNR, and SSIM with the window and padding of 3DGS.

SSIM is equation 13 of Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error
visibility to structural similarity" (2004), with their constants K1 = 0.01, K2 = 0.03 and their
11 x 11 Gaussian window of sigma 1.5. Implementations differ in the treatment of the border, which
changes the second digit; ``SSIM_VARIANT`` describes the reported one.

Images are (H, W, 3): floats in [0, 1], or uint8 where 255 represents 1. All computations are in
float64, on bands of rows: only the map of the measure is held for the whole image. A mask is
(H, W); its non-zero pixels are measured.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.errors import UserError

PSNR_CAP = 100.0
"""PSNR of identical images, dB: JSON has no infinity."""

SSIM_VARIANT = "3DGS: 11x11 Gaussian, sigma 1.5, zero padding, mean over channels"

_RADIUS = 5
_SIGMA = 1.5
_C1 = 0.01**2
_C2 = 0.03**2
# Number of pixels that are measured at a time.
_BAND_PIXELS = 1 << 15


def psnr(image: NDArray[Any], reference: NDArray[Any], mask: NDArray[Any] | None = None) -> float:
    """Peak signal-to-noise ratio in dB, peak 1, over all channels of the unmasked pixels.

    Args:
        image, reference: (H, W, 3).
        mask: (H, W) or None; zero pixels are excluded.

    Returns:
        ``min(-10 log10(mean squared error), PSNR_CAP)``.

    Raises:
        UserError: No pixel is unmasked.
    """
    keep = checked_mask(image, reference, mask)
    squared = np.empty(image.shape)
    for rows in bands(image):
        squared[rows] = (as_float64(image[rows]) - as_float64(reference[rows])) ** 2
    error = float(np.mean(squared if keep is None else squared[keep]))
    return min(-10.0 * np.log10(error), PSNR_CAP) if error > 0.0 else PSNR_CAP


def ssim(
    image: NDArray[Any],
    reference: NDArray[Any],
    mask: NDArray[Any] | None = None,
    *,
    padding: Literal["zero", "valid"] = "zero",
) -> float:
    """Mean structural similarity, averaged over pixels and channels.

    Args:
        image, reference: (H, W, 3).
        mask: (H, W) or None. Masked pixels of the image are replaced by the reference's, so that
            they do not affect neighbouring windows, and are excluded from the mean.
        padding: "zero" pads both images with black, as 3DGS does (``SSIM_VARIANT``); "valid"
            averages only the pixels whose window lies inside the image.

    Raises:
        UserError: No pixel is left to average, or a side is under 11 pixels with "valid".
    """
    keep = checked_mask(image, reference, mask)
    values: NDArray[np.float64] = np.empty(image.shape)
    for rows in bands(image):
        # The windows of the band's pixels reach beyond it.
        first = max(rows.start - _RADIUS, 0)
        reached = slice(first, rows.stop + _RADIUS)
        x, y = as_float64(image[reached]), as_float64(reference[reached])
        if keep is not None:
            x = np.where(keep[reached, :, None], x, y)
        values[rows] = _ssim_map(x, y)[rows.start - first : rows.stop - first]
    if padding == "valid":
        height, width = values.shape[:2]
        if min(height, width) <= 2 * _RADIUS:
            raise UserError(
                f"SSIM without padding needs images of at least 11 x 11 pixels, "
                f"found {width} x {height}",
                fix="use larger images, or zero padding",
            )
        inner = np.s_[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]
        values = values[inner]
        keep = None if keep is None else _not_empty(keep[inner])
    return float(np.mean(values if keep is None else values[keep]))


def _ssim_map(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """SSIM(x, y) of every pixel and channel, with zero padding."""
    mean_x, mean_y = _blur(x), _blur(y)
    variance_x = _blur(x * x) - mean_x**2
    variance_y = _blur(y * y) - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2.0 * covariance + _C2) / (variance_x + variance_y + _C2)
    return luminance * structure


def _blur(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convolution of each channel with the (separable) Gaussian window."""
    offsets = np.arange(-_RADIUS, _RADIUS + 1)
    window = np.exp(-0.5 * (offsets / _SIGMA) ** 2)
    window /= window.sum()
    # cv2 keeps an array of one row or column as it is, but drops a last axis of one.
    blurred = cv2.sepFilter2D(values, -1, window, window, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, np.float64).reshape(values.shape)


def bands(image: NDArray[Any]) -> Iterator[slice]:
    """Bands of rows, each of about ``_BAND_PIXELS``."""
    height, width = image.shape[:2]
    step = max(_BAND_PIXELS // max(width, 1), 1)
    for start in range(0, height, step):
        yield slice(start, min(start + step, height))


def as_float64(image: NDArray[Any]) -> NDArray[np.float64]:
    return image / 255.0 if image.dtype == np.uint8 else image.astype(np.float64)


def checked_mask(
    image: NDArray[Any], reference: NDArray[Any], mask: NDArray[Any] | None
) -> NDArray[np.bool_] | None:
    """The pixels that are measured; None for all.

    Raises:
        ValueError: The shapes differ.
        UserError: No pixel is unmasked.
    """
    if image.shape != reference.shape or image.ndim != 3:
        raise ValueError(f"images of shapes {image.shape} and {reference.shape}")
    if mask is None:
        return None
    if mask.shape != image.shape[:2]:
        raise ValueError(f"mask of shape {mask.shape} for images of shape {image.shape}")
    return _not_empty(mask != 0)


def _not_empty(keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    if not keep.any():
        raise UserError(
            "the mask leaves no pixel to measure",
            fix="leave this view out, or correct its mask (non-zero pixels are measured)",
        )
    return keep
