"""Decoding of photographs, masks and depth maps: the one place where files become pixels.

Pixels are as stored in every format: no orientation of EXIF or TIFF is applied. HEIF's own
rotations are, because they belong to the encoding; its decoded pixels count as the stored ones.
Colours of photographs become sRGB (``colour``), those of masks and depth maps are values.

OpenCV decodes what it decodes rightly. Pillow decodes AVIF and HEIF, TIFF of up to 8 bits (OpenCV
multiplies colours by alpha) and CMYK.

cv2's decoders silently fill the missing part of a truncated file with grey. Truncation is therefore
detected from the file formats' own structure.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from pipeline.io import colour, tiff
from pipeline.io.colour import Colours
from pipeline.io.masks import MaskPixels, valid_pixels
from pipeline.io.photofile import check_size, colours_of_file, opened_image

Picture = NDArray[Any]
_PNG = b"\x89PNG\r\n\x1a\n"
TRUNCATED = "the image is truncated or damaged"
UNREADABLE = "not a readable image (expected JPEG, PNG, TIFF, WebP or AVIF)"


@dataclass(frozen=True)
class _Stored:
    """Pixels as stored.

    Attributes:
        picture: The pixels in OpenCV's layout; (H, W, 4) CMYK if ``cmyk``.
        colours: The file's description of its colours.
    """

    picture: Picture
    colours: Colours
    cmyk: bool = False


def decode_photograph(data: bytes, name: str) -> Picture:
    """Decode a photograph in OpenCV's layout: (H, W) grey, (H, W, 2) grey and alpha, (H, W, 3) BGR
    or (H, W, 4) BGRA; uint8 or uint16, in sRGB.

    Args:
        data: The file's bytes.
        name: The name of the file; its suffix decides which formats are tried.

    Raises:
        ValueError: The picture cannot be decoded; the message has the reason.
    """
    stored = _decoded(data, name)
    if not stored.cmyk and stored.colours.profile is None:
        return stored.picture
    picture, alpha = stored.picture, None
    if not stored.cmyk and picture.ndim == 3:
        if picture.shape[2] in (2, 4):
            picture, alpha = picture[..., :-1], picture[..., -1]
        picture = picture[..., 0] if picture.shape[2] == 1 else picture[..., ::-1]
    converted = colour.to_srgb(np.ascontiguousarray(picture), stored.colours)
    converted = converted[..., ::-1] if converted.ndim == 3 else converted
    return np.ascontiguousarray(converted if alpha is None else np.dstack([converted, alpha]))


def decode_mask(data: bytes, name: str) -> MaskPixels:
    """Decode a mask.

    Raises:
        ValueError: See ``decode_photograph``.
    """
    stored = _decoded(data, name)
    picture = stored.picture
    if stored.cmyk:
        picture = colour.to_srgb(picture, colour.AS_SRGB)
    return valid_pixels(picture, lossless=_is_lossless(data))


def decode_depth(data: bytes) -> Picture | None:
    """Decode a depth map (PNG or TIFF) as stored; None if that is not possible.

    Raises:
        ValueError: The picture is truncated, or has more pixels than photographs have.
    """
    if _is_truncated(data):
        raise ValueError(TRUNCATED)
    if tiff.is_tiff(data):
        layout = tiff.layout_of(data)
        check_size(layout.width, layout.height)
    elif data[:8] == _PNG and len(data) >= 24:
        check_size(*struct.unpack(">II", data[16:24]))
    return _by_opencv(tiff.without_orientation(data) if tiff.is_tiff(data) else data)


def _decoded(data: bytes, name: str) -> _Stored:
    if _is_truncated(data):
        raise ValueError(TRUNCATED)
    if tiff.is_tiff(data):
        data = tiff.without_orientation(data)
    # PIL raises exceptions of many types on damaged files.
    try:
        image = opened_image(io.BytesIO(data), name)
    except ValueError as error:
        raise ValueError(str(error) or UNREADABLE) from None
    except Exception as error:
        raise ValueError(UNREADABLE) from error
    stored: _Stored | None = None
    with image:
        try:
            stored = _stored(data, image)
        except _UnsupportedError:
            raise
        except Exception as error:
            raise ValueError(UNREADABLE) from error
    if stored is None:
        raise ValueError(UNREADABLE)
    if stored.picture.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"pixels of type {stored.picture.dtype} (expected 8 or 16 bits)")
    return stored


class _UnsupportedError(ValueError):
    """A kind of image that is not read, with the reason."""


def _stored(data: bytes, image: Image.Image) -> _Stored | None:
    colours = colours_of_file(image)
    if image.mode == "CMYK":
        return _Stored(np.asarray(image), colours, cmyk=True)
    if image.format in ("AVIF", "HEIF"):
        return _Stored(_by_pillow(image), colours)
    picture = _of_tiff(data, image) if tiff.is_tiff(data) else _by_opencv(data)
    if picture is None and image.format == "PNG":
        return None  # Damaged: Pillow takes missing rows for black.
    if picture is None:  # OpenCV lacks some compressions.
        return _Stored(_by_pillow(image), colours)
    key = image.info.get("transparency")
    if image.format == "PNG" and picture.ndim == 2 and isinstance(key, int):
        picture = _with_key(picture, key, bits=data[24])
    return _Stored(picture, colours)


def _by_opencv(data: bytes) -> Picture | None:
    """Decode an image file's bytes with OpenCV; None if OpenCV cannot read them."""
    if not data:
        return None
    try:
        # None for an unknown format, contrary to OpenCV's type annotations. With this flag, the
        # orientation of EXIF is ignored; that of TIFF is not.
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def _by_pillow(image: Image.Image) -> Picture:
    """Decode an image with 8 bits."""
    if image.mode in ("1", "L"):
        return np.asarray(image.convert("L"))
    if image.mode == "LAB":
        converted = ImageCms.profileToProfile(
            image, ImageCms.createProfile("LAB"), ImageCms.createProfile("sRGB"), outputMode="RGB"
        )
        assert converted is not None
        image = converted
    alpha = "A" in image.mode or "a" in image.mode or "transparency" in image.info
    pixels = np.asarray(image.convert("RGBA" if alpha else "RGB"))
    return np.ascontiguousarray(pixels[..., [2, 1, 0, 3] if alpha else [2, 1, 0]])


def _of_tiff(data: bytes, image: Image.Image) -> Picture | None:
    """Decode TIFF of more than 8 bits, which Pillow reduces to 8; None for others."""
    layout = tiff.layout_of(data)
    if layout.bits <= 8:
        return None
    if image.mode == "RGB" or image.mode.startswith(("I", "F")):
        channels = layout.samples if layout.alpha else min(layout.samples, 3)
    elif image.mode in ("RGBA", "RGBX"):
        channels = 4 if layout.alpha else 3
    else:
        raise _UnsupportedError(f"{layout.bits}-bit TIFF of colours other than grey and RGB")
    picture = _of_planes(data) if layout.separate and layout.samples > 1 else _by_opencv(data)
    if picture is None:
        raise _UnsupportedError("TIFF of more than 8 bits in a compression that is not read")
    if picture.ndim == 3:
        picture = picture[..., :channels]
    if layout.inverted and picture.dtype == np.uint16:
        picture = np.uint16(65535) - picture
    if layout.premultiplied and picture.ndim == 3 and picture.shape[2] == 4:
        picture = _straight(picture)
    return np.ascontiguousarray(picture)


def _of_planes(data: bytes) -> Picture:
    """TIFF with a plane for each channel, which OpenCV reads as if they were interleaved."""
    import tifffile  # Slow to import.

    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            planes = file.pages[0].asarray()
    except Exception as error:
        raise _UnsupportedError(
            f"16-bit TIFF with a plane for each channel, in a compression that is not read; save "
            f"it with interleaved channels ({type(error).__name__})"
        ) from None
    return np.moveaxis(planes, 0, 2)[..., [2, 1, 0, *range(3, len(planes))]]


def _straight(picture: Picture) -> Picture:
    """Colours that are not multiplied by alpha."""
    alpha = picture[..., 3:].astype(np.float64)
    colours = picture[..., :3] * (65535 / np.maximum(alpha, 1))
    return np.dstack([np.rint(colours.clip(0, 65535)).astype(np.uint16), picture[..., 3:]])


def _with_key(grey: Picture, key: int, bits: int) -> Picture:
    """Grey PNG of which one level is transparent, which OpenCV ignores."""
    level = key * (255 // ((1 << bits) - 1)) if bits < 8 else key
    alpha = np.where(grey == level, 0, np.iinfo(grey.dtype).max).astype(grey.dtype)
    return np.dstack([grey, grey, grey, alpha])


# --- completeness -------------------------------------------------------------------------


def _is_lossless(data: bytes) -> bool:
    """Whether the file is of a format that keeps values as they are."""
    return data[:2] == b"BM" or data[:4] == b"\x89PNG" or tiff.is_tiff(data)


def _is_truncated(data: bytes) -> bool:
    """Whether a JPEG, PNG or WebP file is incomplete according to its format."""
    if data[:2] == b"\xff\xd8":
        return not _jpeg_is_complete(data)
    if data[:8] == _PNG:
        return not _png_is_complete(data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return len(data) < 8 + int(struct.unpack("<I", data[4:8])[0])
    return False


def _jpeg_is_complete(data: bytes) -> bool:
    """Whether an end-of-image marker follows the first scan (ITU T.81, annex B).

    The search starts at the scan: the EXIF preview has its own end-of-image marker.
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


def _png_is_complete(data: bytes) -> bool:
    """Whether every chunk up to IEND is present with a correct checksum."""
    for kind, start, end in colour.png_chunks(data):
        stored = data[end : end + 4]
        if len(stored) < 4 or zlib.crc32(data[start - 4 : end]) != int.from_bytes(stored, "big"):
            return False
        if kind == b"IEND":
            return True
    return False
