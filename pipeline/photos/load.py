"""Pictures from files, on the stored pixel grid: EXIF orientation is never applied.

A file is read once: the bytes that are decoded are those whose digest was compared with the
recorded one. Without a recorded digest (None) nothing is compared.

cv2's decoders fill what is missing from a cut-off file with grey and say nothing; the files'
own framing is checked here instead.
"""

from __future__ import annotations

import contextlib
import io
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.io import heif
from pipeline.io.names import suffix_of
from pipeline.io.recorded import read_recorded
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View

Picture = NDArray[Any]
FIX = "Replace the file by a whole one, or remove it from the folder."
# Sizes reached by rounding (images_4/ and the like) still have nearly the same shape.
ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True)
class ViewPixels:
    """One view at its working resolution.

    Attributes:
        rgb: (H, W, 3) uint8, straight (not multiplied by alpha); 0 where alpha is 0.
        alpha: (H, W) uint8, or None where the file has none.
        mask: (H, W) bool, True where pixels count, or None without a mask.
    """

    rgb: NDArray[np.uint8]
    alpha: NDArray[np.uint8] | None
    mask: NDArray[np.bool_] | None


def load_rgb(path: str | Path, digest: str | None = None) -> Picture:
    """Read a picture as (H, W, 3) RGB, uint8 or uint16 as stored; alpha is dropped.

    Args:
        digest: the file's recorded digest (``recorded.digest_of``).

    Raises:
        UserError: the file is missing, cut off, no picture that can be read, or not the one that
            was recorded.
    """
    return _split(read_picture(path, digest))[0]


def load_rgba(
    path: str | Path, digest: str | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Read a picture as (H, W, 3) uint8 RGB and (H, W) uint8 alpha, None where it has none.

    Raises:
        UserError: as ``load_rgb``.
    """
    rgb, alpha = _split(read_picture(path, digest))
    return to_8bit(rgb), None if alpha is None else to_8bit(alpha)


def load_mask(path: str | Path, digest: str | None = None) -> NDArray[np.bool_]:
    """Read a mask as (H, W) bool: True where any colour channel is not zero.

    Raises:
        UserError: as ``load_rgb``.
    """
    return np.asarray(load_rgb(path, digest).any(axis=2))


def read_depth(path: str | Path, digest: str | None = None) -> Picture:
    """Read a depth map (PNG, TIFF, .npy or the first array of an .npz) as it is stored.

    Raises:
        UserError: it cannot be read, or is not the file that was recorded.
    """
    path = Path(path)
    data = read_recorded(path, digest)
    try:
        if path.suffix in (".npy", ".npz"):
            stored = np.load(io.BytesIO(data), allow_pickle=False)
            depth: Picture | None = stored if path.suffix == ".npy" else stored[stored.files[0]]
        else:
            depth = _decode(data)
    except (OSError, ValueError, EOFError, IndexError, zipfile.BadZipFile):
        depth = None
    if depth is None:
        raise UserError(
            "the depth map cannot be read",
            file=path,
            fix="Save it as 16-bit grey PNG, float TIFF or .npy.",
        )
    return depth


def load_depth(path: str | Path, aspect: float, digest: str | None = None) -> NDArray[np.float64]:
    """Read a depth map of one channel as (H, W) float64, values as stored.

    Args:
        aspect: width over height that it must have.

    Raises:
        UserError: as ``read_depth``; or it has several channels, or another shape.
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
            f"is {depth.shape[1]}x{depth.shape[0]} pixels, not of the photograph's shape",
            file=path,
            fix="Depth maps must cover the same picture as the photographs.",
        )
    return depth.astype(np.float64)


def load_view(view: View) -> ViewPixels:
    """Read a view's picture and mask, resized by area to exactly the view's size.

    Colours are averaged weighted by alpha, so that hidden colours never bleed in. A mask's pixel
    counts only if all pixels under it do.

    Raises:
        UserError: as ``load_rgb``; or picture or mask is not of the view's shape.
    """
    width, height = view.width, view.height
    rgb, alpha = load_rgba(view.image, view.image_digest)
    _check_shape(rgb, width, height, Path(view.image))
    mask = None
    if view.mask is not None:
        mask = load_mask(view.mask, view.mask_digest)
        _check_shape(mask, width, height, Path(view.mask))
        mask = resize_mask(mask, width, height)
    return ViewPixels(*resize_rgba(rgb, alpha, width, height), mask)


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
    """Resize an (H, W) mask; a pixel counts only if all pixels under it do: its colour is a mean
    of theirs."""
    return np.asarray(resize_area(mask.astype(np.float32), width, height) > 0.999)


def resize_area(picture: Picture, width: int, height: int) -> Picture:
    """Resize (H, W[, C]) by area averaging; the dtype is kept."""
    if picture.shape[:2] == (height, width):
        return picture
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))


def to_8bit(values: Picture) -> NDArray[np.uint8]:
    """uint8 as it is; uint16 rounded, 65535 to 255."""
    if values.dtype == np.uint8:
        return values
    return ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)


def read_picture(path: str | Path, digest: str | None = None) -> Picture:
    """Read a picture as OpenCV gives it: (H, W) grey, (H, W, 2) grey and alpha, (H, W, 3) BGR or
    (H, W, 4) BGRA; uint8 or uint16.

    Raises:
        UserError: as ``load_rgb``.
    """
    path = Path(path)
    data = read_recorded(path, digest)
    if _is_cut_off(data):
        raise UserError("the picture is cut off or damaged", file=path, fix=FIX)
    picture: Picture | None = None
    if suffix_of(path.name) in heif.HEIF_SUFFIXES:
        with contextlib.suppress(OSError, ValueError):
            picture = heif.read_pixels(io.BytesIO(data))
    else:
        picture = _decode(data)
    if picture is None:
        raise UserError(
            "not a picture that can be read (expected JPEG, PNG, TIFF or WebP)", file=path, fix=FIX
        )
    if picture.dtype not in (np.uint8, np.uint16):
        raise UserError(
            f"pixels of type {picture.dtype} (expected 8 or 16 bits)",
            file=path,
            fix="Convert the picture to 8-bit or 16-bit PNG.",
        )
    return picture


def _decode(data: bytes) -> Picture | None:
    """OpenCV's picture of a file's bytes; None where it is none that OpenCV reads."""
    if not data:
        return None
    try:
        # None where no decoder knows the file, unlike what OpenCV's type annotations say.
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def _split(picture: Picture) -> tuple[Picture, Picture | None]:
    """OpenCV's grey, grey + alpha, BGR or BGRA as RGB and alpha."""
    if picture.ndim == 2:
        picture = picture[..., None]
    channels = picture.shape[2]
    alpha = np.ascontiguousarray(picture[..., -1]) if channels in (2, 4) else None
    if channels <= 2:
        return np.repeat(picture[..., :1], 3, axis=2), alpha
    if channels == 3:  # By cv2, which is several times as fast as a copy of a reversed view.
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)), alpha
    return np.ascontiguousarray(picture[..., 2::-1]), alpha


def _check_shape(picture: Picture, width: int, height: int, path: Path) -> None:
    found_height, found_width = picture.shape[:2]
    if abs(found_width * height / (found_height * width) - 1) > ASPECT_TOLERANCE:
        raise UserError(
            f"is {found_width}x{found_height} pixels (expected the shape of {width}x{height})",
            file=path,
            fix="Use the picture its camera was made for, neither turned nor cropped.",
        )


def _is_cut_off(data: bytes) -> bool:
    """True where a JPEG, PNG or WebP file ends before its format says it does."""
    if data[:2] == b"\xff\xd8":
        return not _jpeg_ends(data)
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return not _png_is_whole(data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return len(data) < 8 + int(struct.unpack("<I", data[4:8])[0])
    return False


def _jpeg_ends(data: bytes) -> bool:
    """True if an end-of-image marker follows the first scan (ITU T.81, annex B).

    Searched from the scan on: the preview inside EXIF has an end of its own.
    """
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker == 0xDA:
            return data.find(b"\xff\xd9", at) >= 0
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False


def _png_is_whole(data: bytes) -> bool:
    """True if every chunk up to IEND is there with its checksum (PNG specification, section 5)."""
    at = 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 8 + length
        if end + 4 > len(data):
            return False
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end + 4
    return False
