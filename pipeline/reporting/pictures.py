"""Images for pages: error maps, display orientation, JPEG in HTML."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.reporting.data import Comparison

Picture = NDArray[np.uint8]

ERROR_SCALE = 0.2
"""Absolute error, for colours in [0, 1], of the brightest colour; larger errors are clipped.
The scale is fixed, so that maps of different views and scenes are comparable."""

MASKED_GREY = 128

_ERROR_COLOURS, _TRUST_COLOURS = cv2.COLORMAP_INFERNO, cv2.COLORMAP_VIRIDIS
_PAGE_SIDE = 900
_JPEG_QUALITY = 86
# Bytes of JPEG in one page; base64 adds a third.
_PAGE_BUDGET = 3_300_000


def error_map(image: NDArray[Any], reference: NDArray[Any], mask: NDArray[Any] | None) -> Picture:
    """Absolute error, averaged over channels, in a perceptually uniform colour map.

    Args:
        image, reference: (H, W, 3), both uint8 or both floats in [0, 1].
        mask: (H, W), zero pixels are grey; or None.

    Returns:
        (H, W, 3) uint8; black is no error, the brightest yellow ``ERROR_SCALE`` or more.
    """
    top = 255.0 if image.dtype == np.uint8 else 1.0
    error = np.abs(image.astype(np.float64) - reference).mean(axis=2) / top
    colours = _colours(_ERROR_COLOURS)
    index = np.rint(np.clip(error / ERROR_SCALE, 0, 1) * (len(colours) - 1)).astype(np.intp)
    picture = colours[index]
    if mask is not None:
        picture[mask == 0] = MASKED_GREY
    return picture


def trust_colours(trust: Picture) -> Picture:
    """(H, W) uint8 trust, 255 is 1, as (H, W, 3) in a perceptually uniform colour map; yellow is
    high."""
    return _colours(_TRUST_COLOURS)[trust]


@cache
def _colours(colour_map: int) -> Picture:
    """(256, 3) uint8 RGB of one of OpenCV's colour maps."""
    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], colour_map)
    return np.asarray(bgr[:, 0, ::-1], np.uint8)


def scale_gradient() -> str:
    """The error map's colours as a CSS gradient, left to right."""
    return _gradient(_ERROR_COLOURS)


def trust_gradient() -> str:
    """The colours of the trust map as a CSS gradient, left to right."""
    return _gradient(_TRUST_COLOURS)


def _gradient(colour_map: int) -> str:
    stops = [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in _colours(colour_map)[:: 255 // 15]]
    return f"linear-gradient(to right, {', '.join(stops)})"


def upright(picture: Picture, orientation: int) -> Picture:
    """The image rotated and flipped by its EXIF orientation; unknown values have no effect."""
    if orientation >= 5:
        picture = picture.swapaxes(0, 1)  # 5: transposed; 6, 7, 8: transposed, then flipped
    flip_vertically, flip_horizontally = {
        2: (False, True),
        3: (True, True),
        4: (True, False),
        6: (False, True),
        7: (True, True),
        8: (True, False),
    }.get(orientation, (False, False))
    rows = slice(None, None, -1 if flip_vertically else 1)
    columns = slice(None, None, -1 if flip_horizontally else 1)
    return np.ascontiguousarray(picture[rows, columns])


def triple(view: Comparison) -> tuple[Picture, Picture, Picture]:
    """Photograph, render and error map in display orientation."""
    error = error_map(view.render, view.photograph, view.mask)
    photograph, render, error = (
        upright(p, view.orientation) for p in (view.photograph, view.render, error)
    )
    return photograph, render, error


def shrunk(picture: Picture, max_side: int) -> Picture:
    """The image reduced by area averaging so that no side is longer than ``max_side`` pixels."""
    height, width = picture.shape[:2]
    scale = max_side / max(height, width)
    if scale >= 1:
        return picture
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))


class Embedded(NamedTuple):
    """An image in a page: its data URI, and its size in pixels."""

    uri: str
    width: int
    height: int


def page_pictures(views: Sequence[Comparison]) -> list[dict[str, Embedded]]:
    """The photograph, render and error map of each view, reduced to fit a total size in bytes."""
    triples = [triple(view) for view in views]
    side = _PAGE_SIDE
    while True:
        rows = [[embedded(shrunk(picture, side)) for picture in row] for row in triples]
        # base64 makes 4 characters of 3 bytes.
        size = sum(len(picture.uri) for row in rows for picture in row) * 3 // 4
        if size <= _PAGE_BUDGET or side <= 100:
            kinds = "photograph", "render", "error"
            return [dict(zip(kinds, row, strict=True)) for row in rows]
        side = side * 4 // 5


def embedded(picture: Picture, quality: int = _JPEG_QUALITY) -> Embedded:
    """The image as a JPEG data URI."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=quality, optimize=True)
    uri = "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
    return Embedded(uri, picture.shape[1], picture.shape[0])
