"""Images for pages: error maps, display orientation, JPEG in HTML."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from functools import cache
from typing import Any

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


def page_pictures(views: Sequence[Comparison]) -> list[list[tuple[str, int, int]]]:
    """The triples of all views for one page, reduced to fit a total size in bytes.

    Returns:
        For each view its photograph, render and error map as (data URI, width, height).
    """
    triples = [triple(view) for view in views]
    side = _PAGE_SIDE
    while True:
        small = [[shrunk(picture, side) for picture in pictures] for pictures in triples]
        encoded = [[_jpeg(picture) for picture in pictures] for pictures in small]
        if sum(len(data) for row in encoded for data in row) <= _PAGE_BUDGET or side <= 100:
            break
        side = side * 4 // 5
    return [
        [
            (_data_uri(data), picture.shape[1], picture.shape[0])
            for data, picture in zip(row, pictures, strict=True)
        ]
        for row, pictures in zip(encoded, small, strict=True)
    ]


def data_uri(picture: Picture) -> str:
    """The image as a JPEG data URI."""
    return _data_uri(_jpeg(picture))


def _jpeg(picture: Picture) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=_JPEG_QUALITY, optimize=True)
    return buffer.getvalue()


def _data_uri(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
