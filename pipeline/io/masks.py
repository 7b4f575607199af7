"""Which pixels a mask keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Share of the visible pixels that are near black or near white in an image that is a mask. The
# colours of a photograph that was cut out are no mask, its alpha is.
_MASK_SHARE = 0.9
# Distance of grey levels from black or white up to which they are near, and difference of channels
# from which a dark pixel has a colour: segmentations colour their classes. Both of a range of 1.
_NEAR, _COLOURED = 0.15, 0.25


@dataclass(frozen=True)
class MaskPixels:
    """A decoded mask.

    Attributes:
        valid: (H, W) True for pixels that count.
        darkest: The largest value if it is below half of the range and every other value than 0
            counts, else None.
    """

    valid: NDArray[np.bool_]
    darkest: int | None = None


def valid_pixels(picture: NDArray[Any], *, lossless: bool) -> MaskPixels:
    """The pixels that a mask keeps: those of at least half of the range in any channel, or of a
    colour, that are at least half opaque.

    Args:
        picture: (H, W) grey, (H, W, 2) grey and alpha, (H, W, 3) colours or (H, W, 4) colours and
            alpha; uint8 or uint16.
        lossless: Whether the file has the values that a program wrote. Only then may all of them
            be small: 0 and 1, or numbers of classes.
    """
    top = int(np.iinfo(picture.dtype).max)
    if picture.ndim == 2:
        picture = picture[..., None]
    colours, alpha = picture, None
    if picture.shape[2] in (2, 4):
        colours, alpha = picture[..., :-1], picture[..., -1]
    largest = colours.max(axis=2)
    opaque = None if alpha is None or alpha.min() == top else alpha > top // 2
    if opaque is not None:
        uniform = bool((colours == colours[0, 0]).all())
        if uniform or _is_cut_out(colours, largest, opaque, top):
            return MaskPixels(opaque)
        if not opaque.any():
            opaque = None  # Some programs write an alpha of 0 everywhere.
    valid, darkest = _bright(colours, largest, top, lossless=lossless)
    return MaskPixels(valid if opaque is None else valid & opaque, darkest)


def _is_cut_out(
    colours: NDArray[Any], largest: NDArray[Any], opaque: NDArray[np.bool_], top: int
) -> bool:
    """Whether alpha alone is the mask: the visible pixels have one bright colour, or the colours
    of a photograph."""
    values = largest[opaque]
    if not len(values) or opaque.all():
        return False
    visible = colours[opaque]
    if (visible == visible[0]).all():
        return bool(values[0] > top // 2)
    near = (values <= _NEAR * top) | (values >= (1 - _NEAR) * top)
    return float(near.mean()) < _MASK_SHARE


def _bright(
    colours: NDArray[Any], largest: NDArray[Any], top: int, *, lossless: bool
) -> tuple[NDArray[np.bool_], int | None]:
    valid = largest > top // 2
    if colours.shape[2] == 3:
        # Unsigned values do not wrap around here: the largest is at least the smallest.
        valid |= largest - colours.min(axis=2) >= _COLOURED * top
    highest, lowest = int(largest.max()), int(largest.min())
    if valid.any() or highest == 0 or not lossless:
        return valid, None
    if highest == 1:
        return largest > 0, None
    return (largest > 0, highest) if lowest == 0 else (valid, None)
