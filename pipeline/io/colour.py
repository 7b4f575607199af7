"""The colour space of a photograph, and conversion of its pixels to sRGB.

Colours are described by an embedded ICC profile, else by code points (PNG's cICP, HEIF's and AVIF's
nclx), else by PNG's gAMA and cHRM, else by EXIF. Without any of them a photograph is sRGB. All
descriptions become ICC profiles, which Pillow's colour management (LittleCMS) applies, relative
colorimetric with black point compensation.

Sources: ITU-T H.273 (code points); W3C "Portable Network Graphics (PNG) Specification, Third
Edition", section 11.3.2; JEITA CP-3451 (EXIF) and CP-3461 (DCF, "R03").
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

from pipeline.io import icc

Pixels = NDArray[Any]
Kind = Literal["RGB", "L", "CMYK"]

# Larger profiles are not read: real ones of printers have up to 3 MB.
_MAX_PROFILE = 8 << 20
# Largest change of an 8-bit value by a profile that counts as sRGB. The profiles of that name
# differ by up to 2; some have tables, which map black to the black of print.
_SRGB_LEVELS, _NAMED_SRGB_LEVELS = 3, 24
_MODES: dict[str, Kind] = {"RGB ": "RGB", "GRAY": "L", "CMYK": "CMYK"}
_PRIMARIES: dict[int, tuple[str, icc.Chromaticities]] = {
    1: ("sRGB", icc.SRGB),
    5: ("PAL", ((0.64, 0.33), (0.29, 0.60), (0.15, 0.06), icc.D65)),
    6: ("NTSC", ((0.630, 0.340), (0.310, 0.595), (0.155, 0.070), icc.D65)),
    9: ("BT.2020", icc.BT2020),
    11: ("DCI-P3", icc.DCI_P3),
    12: ("Display P3", icc.DISPLAY_P3),
}
# The curves of cameras (BT.601, BT.709, BT.2020) are displayed as sRGB's is; 2 is "unspecified".
_TRANSFERS: dict[int, icc.Curve] = {
    **dict.fromkeys((1, 2, 6, 13, 14, 15), icc.SRGB_CURVE),
    4: (2.2,),
    5: (2.8,),
    8: (1.0,),
}
_HDR = {16: "PQ", 18: "HLG"}
_UNSPECIFIED = 2
# Exponents of PNG's gAMA that programs write for sRGB.
_GAMMA_OF_SRGB = (0.43, 0.48)
# Rows of an image that are converted at a time.
_ROWS = 256


@dataclass(frozen=True)
class Colours:
    """What a file says about its colours.

    Attributes:
        profile: The ICC profile by which they are converted to sRGB; None if they are used as
            sRGB.
        name: The name of the colour space that is converted; empty for sRGB.
        fault: Why the colours are used as sRGB although the file says something else; empty
            otherwise.
    """

    profile: bytes | None = None
    name: str = ""
    fault: str = ""


AS_SRGB = Colours()


def colours_of(image: Image.Image, tags: Mapping[int, Any]) -> Colours:
    """The colours of an image that was opened by PIL.

    Args:
        tags: The EXIF data of the image, with that of the directories Exif and (as a mapping)
            Interop.
    """
    mode: Kind = "CMYK" if image.mode == "CMYK" else "L" if _is_grey(image.mode) else "RGB"
    embedded = image.info.get("icc_profile")
    if embedded:
        return _of_profile(bytes(embedded), mode)
    if mode == "CMYK":
        return Colours(fault="CMYK without a colour profile")
    if image.mode == "LAB":
        return AS_SRGB  # Converted when it is decoded.
    codes = _codes(image)
    if codes is not None:
        return _of_codes(*codes, mode)
    if image.format == "PNG" and "srgb" not in image.info and "gamma" in image.info:
        return _of_png(image, mode)
    interop = tags.get(ExifTags.IFD.Interop) or {}
    index = str(interop.get(1, "")).strip("\0 ") if isinstance(interop, Mapping) else ""
    space = tags.get(ExifTags.Base.ColorSpace)
    if space == 2 or (index == "R03" and space != 1):
        return _of_primaries("Adobe RGB", icc.ADOBE_RGB, (563 / 256,), mode)
    return AS_SRGB


def to_srgb(pixels: Pixels, colours: Colours) -> Pixels:
    """Convert pixels to sRGB.

    Args:
        pixels: (H, W) grey, (H, W, 3) RGB or (H, W, 4) CMYK; uint8, or uint16 for grey and RGB.
        colours: The colours of the file. Without a profile, CMYK is converted by Pillow, and other
            pixels are returned unchanged.

    Returns:
        (H, W) grey or (H, W, 3) RGB of the same dtype.
    """
    profile = colours.profile
    if profile is None:
        if _mode(pixels) == "CMYK":
            return np.asarray(Image.fromarray(pixels, "CMYK").convert("RGB"))
        return pixels
    if pixels.dtype == np.uint16:
        matrix = icc.read_profile(profile)
        if matrix is not None:
            return _by_matrix(pixels, matrix)
        # LittleCMS in Pillow has 8 bits.
        reduced = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
        return to_srgb(reduced, colours).astype(np.uint16) * np.uint16(257)
    mode, expected = _mode(pixels), _space_of(profile)
    if mode == "L" and expected == "RGB":
        pixels, mode = np.repeat(pixels[..., None], 3, axis=2), "RGB"
    transform = _transform(profile, mode)
    image = ImageCms.applyTransform(Image.fromarray(pixels, mode), transform)
    assert image is not None
    return np.asarray(image)


# --- what files say -----------------------------------------------------------------------


def _is_grey(mode: str) -> bool:
    return mode in ("1", "L", "LA", "La") or mode.startswith("I")


def _of_profile(data: bytes, mode: Kind) -> Colours:
    name, fault, is_srgb = _inspected(data, mode)
    if fault:
        return Colours(fault=fault)
    return AS_SRGB if is_srgb else Colours(data, name)


@lru_cache(maxsize=64)
def _inspected(data: bytes, mode: Kind) -> tuple[str, str, bool]:
    """The name of an embedded profile, why it cannot be used (empty if it can), and whether it is
    sRGB."""
    if len(data) > _MAX_PROFILE:
        return "", f"a colour profile of {len(data) >> 20} MiB", False
    # Pillow raises exceptions of several types on damaged profiles.
    try:
        name = _description(data)
        space = _space_of(data)
        if space != mode and not (mode == "L" and space == "RGB"):
            return "", f"the colour profile {name!r} of an image of other channels", False
        change = _largest_change(data, space)
    except Exception:
        return "", "a damaged colour profile", False
    named = name.lower().startswith("srgb")
    return name, "", change <= (_NAMED_SRGB_LEVELS if named else _SRGB_LEVELS)


def _description(data: bytes) -> str:
    profile = ImageCms.ImageCmsProfile(io.BytesIO(data))
    text = ""
    with contextlib.suppress(Exception):
        text = ImageCms.getProfileDescription(profile)
    plain = "".join(c for c in text if c.isprintable()).strip()
    return plain[:60] or "unnamed profile"


def _space_of(data: bytes) -> Kind:
    """Raises: ValueError: it is a profile of other colours."""
    space = data[16:20].decode("latin-1")
    if space not in _MODES:
        raise ValueError(f"a profile of {space!r}")
    return _MODES[space]


def _largest_change(data: bytes, space: Kind) -> int:
    """Largest change of an 8-bit value by the conversion to sRGB."""
    if space == "CMYK":
        _transform(data, space)
        return 255
    levels = np.arange(0, 256, 15 if space == "RGB" else 1, dtype=np.uint8)
    if space == "L":
        samples = levels[None]
    else:
        grid = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1)
        samples = grid.reshape(len(levels), -1, 3)
    image = ImageCms.applyTransform(Image.fromarray(samples, space), _transform(data, space))
    assert image is not None
    converted = np.asarray(image).astype(int)
    return int(np.abs(converted - (samples[..., None] if space == "L" else samples)).max())


def _codes(image: Image.Image) -> tuple[int, int] | None:
    """The code points of primaries and transfer function that the file has, or None."""
    if image.format == "PNG":
        return _chunk_of_png(image)
    if image.format not in ("AVIF", "HEIF"):
        return None
    nclx = image.info.get("nclx_profile")
    if isinstance(nclx, Mapping):
        unknown = _UNSPECIFIED
        return int(nclx.get("color_primaries", unknown)), int(
            nclx.get("transfer_characteristics", unknown)
        )
    return _box_of_avif(image)


def _chunk_of_png(image: Image.Image) -> tuple[int, int] | None:
    """The chunk cICP, which precedes the pixels and which Pillow does not read."""
    head = _head(image)
    for kind, start, end in png_chunks(head):
        if kind == b"cICP" and end - start == 4:
            return head[start], head[start + 1]
        if kind == b"IDAT":
            break
    return None


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """The kind of each chunk of a PNG file, and where its content begins and, if ``data`` is whole,
    ends (PNG specification, section 5)."""
    at = 8
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        yield data[at + 4 : at + 8], at + 8, end
        at = end + 4


def _box_of_avif(image: Image.Image) -> tuple[int, int] | None:
    head = _head(image)
    at = head.find(b"colrnclx")
    if at < 0 or at + 12 > len(head):
        return None
    return int.from_bytes(head[at + 8 : at + 10], "big"), int.from_bytes(
        head[at + 10 : at + 12], "big"
    )


def _head(image: Image.Image) -> bytes:
    """The first bytes of the file that an image was opened from."""
    file = getattr(image, "fp", None)
    if file is None:
        return b""
    before = file.tell()
    try:
        file.seek(0)
        return bytes(file.read(1 << 16))
    finally:
        file.seek(before)


def _of_codes(primaries: int, transfer: int, mode: Kind) -> Colours:
    if transfer in _HDR:
        return Colours(fault=f"{_HDR[transfer]} (high dynamic range)")
    if primaries == _UNSPECIFIED:
        primaries = 1
    if primaries not in _PRIMARIES or transfer not in _TRANSFERS:
        return Colours(fault=f"unknown colours (code points {primaries} and {transfer})")
    name, chromaticities = _PRIMARIES[primaries]
    return _of_primaries(name, chromaticities, _TRANSFERS[transfer], mode)


def _of_png(image: Image.Image, mode: Kind) -> Colours:
    """gAMA and cHRM."""
    gamma, values = float(image.info["gamma"]), image.info.get("chromaticity")
    curve = icc.SRGB_CURVE
    if not _GAMMA_OF_SRGB[0] <= gamma <= _GAMMA_OF_SRGB[1]:
        if not 0.1 <= gamma <= 2:
            return Colours(fault=f"gamma {gamma:g}")
        curve = (1 / gamma,)
    chromaticities = icc.SRGB
    if values is not None and len(values) == 8:
        white, *primaries = zip(values[::2], values[1::2], strict=True)
        chromaticities = (primaries[0], primaries[1], primaries[2], white)
    name = "gAMA and cHRM" if values else f"gamma {1 / gamma:.3g}"
    return _of_primaries(name, chromaticities, curve, mode)


def _of_primaries(
    name: str, chromaticities: icc.Chromaticities, curve: icc.Curve, mode: Kind
) -> Colours:
    try:
        profile = icc.write_profile(name, chromaticities, curve)
    except ValueError as error:
        return Colours(fault=str(error))
    # Its name is not asked: BT.709's primaries with another curve are not sRGB.
    _, fault, _ = _inspected(profile, mode)
    if fault:
        return Colours(fault=fault)
    if _largest_change(profile, "RGB") <= _SRGB_LEVELS:
        return AS_SRGB
    if chromaticities == icc.SRGB and len(curve) == 1:
        name = f"gamma {curve[0]:.3g}"
    return Colours(profile, name)


# --- conversion ---------------------------------------------------------------------------


def srgb_curve(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """sRGB's transfer function (IEC 61966-2-1) of linear light in [0, 1]."""
    curved = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, curved).astype(np.float32)


def linear_to_srgb_primaries(
    light: NDArray[np.float32], to_xyz: NDArray[np.float64]
) -> NDArray[np.float32]:
    """(..., 3) linear light with sRGB's primaries, of which values may be below 0 or above 1.

    Args:
        to_xyz: The (3, 3) matrix of the light's primaries (``icc.matrix_of``).
    """
    matrix = np.linalg.solve(icc.matrix_of(icc.SRGB), to_xyz).astype(np.float32)
    red, green, blue = light[..., 0], light[..., 1], light[..., 2]
    # Avoid a matrix product, whose bits may depend on the number of threads.
    rows = [row[0] * red + row[1] * green + row[2] * blue for row in matrix]
    return np.stack(rows, axis=-1)


def _by_matrix(pixels: Pixels, profile: icc.MatrixProfile) -> Pixels:
    """Convert (H, W) or (H, W, 3) uint16 in float32."""
    out = np.empty_like(pixels)
    for start in range(0, len(pixels), _ROWS):
        rows = pixels[start : start + _ROWS]
        if pixels.ndim == 2:
            light = profile.curves[0][rows]
        else:
            linear = np.stack([profile.curves[i][rows[..., i]] for i in range(3)], axis=-1)
            light = linear_to_srgb_primaries(linear, profile.matrix)
        out[start : start + _ROWS] = np.rint(srgb_curve(light.clip(0, 1)) * 65535)
    return out


def _mode(pixels: Pixels) -> Kind:
    return "L" if pixels.ndim == 2 else "CMYK" if pixels.shape[2] == 4 else "RGB"


def _transform(profile: bytes, mode: Kind) -> ImageCms.ImageCmsTransform:
    return ImageCms.buildTransform(
        ImageCms.ImageCmsProfile(io.BytesIO(profile)),
        ImageCms.createProfile("sRGB"),
        mode,
        "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
        ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )
