"""Load images, masks and depth maps, as stored: no orientation is ever applied
(``pipeline.io.pictures``).

If a recorded digest is given, the file is read once: its digest is that of the decoded bytes.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.io.arrays import read_archive, read_array
from pipeline.io.masks import MaskPixels
from pipeline.io.names import suffix_of
from pipeline.io.pictures import decode_depth, decode_mask, decode_photograph
from pipeline.io.recorded import read_recorded
from pipeline.runtime.errors import UserError
from pipeline.runtime.text import shortened
from pipeline.scene.views import Crop, View

Picture = NDArray[Any]
T = TypeVar("T")
FIX = "Replace the file by an undamaged one, or remove it from the folder."
# The largest relative difference of aspect ratios: sizes of downscaled images are rounded.
ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True)
class ViewPixels:
    """One view at its working resolution.

    Attributes:
        rgb: (H, W, 3) uint8, straight (not multiplied by alpha); 0 where alpha is 0.
        alpha: (H, W) uint8, or None if the file has none.
        mask: (H, W) bool, True for valid pixels, or None without a mask.
    """

    rgb: NDArray[np.uint8]
    alpha: NDArray[np.uint8] | None
    mask: NDArray[np.bool_] | None

    def over(self, background: tuple[float, float, float]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 photograph, composited over the background (RGB in [0, 1]) if it has an
        alpha channel."""
        if self.alpha is None:
            return self.rgb
        alpha = self.alpha[..., None] / 255.0
        color = self.rgb / 255.0 * alpha + np.array(background) * (1 - alpha)
        return np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8)


def load_rgb(path: str | Path, digest: str | None = None) -> Picture:
    """Read an image as (H, W, 3) RGB, uint8 or uint16 as stored; alpha is dropped.

    Args:
        digest: The file's recorded digest (``recorded.digest_of``).

    Raises:
        UserError: The file is missing, truncated, not a readable image, or its digest differs.
    """
    return _split(read_picture(path, digest))[0]


def load_rgba(
    path: str | Path, digest: str | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Read an image as (H, W, 3) uint8 RGB and (H, W) uint8 alpha, None without alpha.

    Raises:
        UserError: See ``load_rgb``.
    """
    rgb, alpha = _split(read_picture(path, digest))
    return to_8bit(rgb), None if alpha is None else to_8bit(alpha)


def load_mask(path: str | Path, digest: str | None = None) -> NDArray[np.bool_]:
    """Read a mask as (H, W) bool, True for the pixels that count (``masks.valid_pixels``).

    Raises:
        UserError: See ``load_rgb``.
    """
    return read_mask(path, digest).valid


def read_mask(path: str | Path, digest: str | None = None) -> MaskPixels:
    """Read a mask, with what was found of its values.

    Raises:
        UserError: See ``load_rgb``.
    """
    return _decoded(path, digest, decode_mask)


def read_depth(path: str | Path, digest: str | None = None) -> Picture:
    """Read a depth map (PNG, TIFF, .npy, or the first array of an .npz) as stored.

    Raises:
        UserError: The file cannot be read, or its digest differs.
    """
    path = Path(path)
    data = read_recorded(path, digest)
    try:
        if suffix_of(path.name) == ".npy":
            depth: Picture | None = read_array(data)
        elif suffix_of(path.name) == ".npz":
            depth = next(iter(read_archive(io.BytesIO(data)).values()), None)
        else:
            depth = decode_depth(data)
        reason = ""
    except ValueError as error:
        depth, reason = None, f": {shortened(str(error))}"
    if depth is None:
        raise UserError(
            f"the depth map cannot be read{reason}",
            file=path,
            fix="Save it as 16-bit grey PNG, float TIFF or .npy.",
        )
    return depth


def load_depth(path: str | Path, aspect: float, digest: str | None = None) -> NDArray[np.float64]:
    """Read a depth map with one channel as (H, W) float64, values as stored.

    Args:
        aspect: The expected ratio of width to height.

    Raises:
        UserError: See ``read_depth``, or the map has several channels or another aspect ratio.
    """
    path = Path(path)
    depth = read_depth(path, digest)
    if depth.ndim == 3 and depth.shape[2] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or depth.dtype.kind not in "uif" or not depth.size:
        raise UserError(
            f"expected a depth map of one channel; found {depth.dtype} of shape {depth.shape}",
            file=path,
            fix="Save depths as 16-bit grey PNG, float TIFF or .npy.",
        )
    if abs(depth.shape[1] / depth.shape[0] / aspect - 1.0) > ASPECT_TOLERANCE:
        raise UserError(
            f"is {depth.shape[1]}x{depth.shape[0]} pixels, another aspect ratio than the "
            "photograph's",
            file=path,
            fix="Depth maps must cover the whole photograph.",
        )
    return depth.astype(np.float64)


def load_view(view: View) -> ViewPixels:
    """Read a view's image and mask, resized by area averaging to the view's size.

    Colours are weighted by alpha, so that colours of transparent pixels have no influence. A mask
    pixel is valid only if all source pixels that it covers are valid.

    Raises:
        UserError: See ``load_rgb``, or the image or mask has another aspect ratio than the view.
    """
    crop = view.crop
    width, height = (
        (view.width, view.height) if crop is None else (crop.full_width, crop.full_height)
    )
    rgb, alpha = load_rgba(view.image, view.image_digest)
    _check_shape(rgb, width, height, Path(view.image))
    mask = None
    if view.mask is not None:
        mask = load_mask(view.mask, view.mask_digest)
        _check_shape(mask, width, height, Path(view.mask))
        mask = resize_mask(mask, width, height)
    pixels = ViewPixels(*resize_rgba(rgb, alpha, width, height), mask)
    return pixels if crop is None else _cropped(pixels, view, crop)


def _cropped(pixels: ViewPixels, view: View, crop: Crop) -> ViewPixels:
    rows = slice(crop.top, crop.top + view.height)
    columns = slice(crop.left, crop.left + view.width)
    return ViewPixels(
        np.ascontiguousarray(pixels.rgb[rows, columns]),
        None if pixels.alpha is None else np.ascontiguousarray(pixels.alpha[rows, columns]),
        None if pixels.mask is None else np.ascontiguousarray(pixels.mask[rows, columns]),
    )


def resize_rgba(
    rgb: NDArray[np.uint8], alpha: NDArray[np.uint8] | None, width: int, height: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Resize (H, W, 3) uint8 colours and (H, W) uint8 alpha by area, colours weighted by alpha."""
    if alpha is None:
        return resize_area(rgb, width, height), None
    if rgb.shape[:2] == (height, width):
        return np.where(alpha[..., None] > 0, rgb, np.uint8(0)), alpha
    weight = alpha.astype(np.float32)
    small_weight = resize_area(weight, width, height)
    light = resize_area(rgb * weight[..., None], width, height)
    small_alpha = np.rint(small_weight).astype(np.uint8)
    colour = np.rint(light / np.maximum(small_weight, 1e-6)[..., None]).clip(0, 255)
    return np.where(small_alpha[..., None] > 0, colour, 0).astype(np.uint8), small_alpha


def resize_mask(mask: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """Resize an (H, W) mask. A pixel is valid only if all source pixels that it covers are, because
    its colour is their mean."""
    return np.asarray(resize_area(mask.astype(np.float32), width, height) > 0.999)


def resize_area(picture: Picture, width: int, height: int) -> Picture:
    """Resize (H, W[, C]) by area averaging; the dtype is unchanged."""
    if picture.shape[:2] == (height, width):
        return picture
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))


def to_8bit(values: Picture) -> NDArray[np.uint8]:
    """The image with uint8 values unchanged, uint16 scaled from 65535 to 255 and rounded."""
    if values.dtype == np.uint8:
        return values
    return ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)


def read_picture(path: str | Path, digest: str | None = None) -> Picture:
    """Read a photograph in OpenCV's layout, in sRGB (``pictures.decode_photograph``).

    Raises:
        UserError: See ``load_rgb``.
    """
    return _decoded(path, digest, decode_photograph)


def _decoded(path: str | Path, digest: str | None, decode: Callable[[bytes, str], T]) -> T:
    path = Path(path)
    data = read_recorded(path, digest)
    try:
        return decode(data, path.name)
    except ValueError as error:
        raise UserError(str(error), file=path, fix=FIX) from None


def _split(picture: Picture) -> tuple[Picture, Picture | None]:
    """Convert OpenCV's grey, grey + alpha, BGR or BGRA to RGB and alpha."""
    if picture.ndim == 2:
        picture = picture[..., None]
    channels = picture.shape[2]
    alpha = np.ascontiguousarray(picture[..., -1]) if channels in (2, 4) else None
    if channels <= 2:
        return np.repeat(picture[..., :1], 3, axis=2), alpha
    if channels == 3:  # cv2 is several times faster than a copy of a reversed view.
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)), alpha
    return np.ascontiguousarray(picture[..., 2::-1]), alpha


def _check_shape(picture: Picture, width: int, height: int, path: Path) -> None:
    found_height, found_width = picture.shape[:2]
    if abs(found_width * height / (found_height * width) - 1) > ASPECT_TOLERANCE:
        raise UserError(
            f"is {found_width}x{found_height} pixels (expected the aspect ratio of "
            f"{width}x{height})",
            file=path,
            fix="Use the image that the camera belongs to, neither rotated nor cropped.",
        )
