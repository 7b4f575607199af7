"""Metadata of image files: size, bit depth, EXIF; read without decoding all pixels."""

from __future__ import annotations

import contextlib
import datetime
import math
import os
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError
from pydantic import BaseModel, ConfigDict

from pipeline.io import exr, pillow_formats
from pipeline.io.colour import Colours, colours_of
from pipeline.io.gps import Fault, Position, number_or_nan, read_gps
from pipeline.io.names import RAW_SUFFIXES, suffix_of
from pipeline.io.panorama import Panorama, panorama_of
from pipeline.io.recorded import MAX_BYTES, digest_of
from pipeline.runtime.errors import UserError

# ``check_size`` takes the place of PIL's limit, which is lower than some photographs are large.
Image.MAX_IMAGE_PIXELS = None
MAX_PIXELS = 1 << 29
"""Largest number of pixels of a photograph or of a video's frame: 1.5 GiB when it is decoded."""
# Decoders that hold several copies of the pixels, and the bytes that they take for each.
_DECODER_BYTES = {"WEBP": 24, "AVIF": 16, "HEIF": 16}
_MAX_DECODED = 3 << 30
# The number of bytes of XMP that are searched.
_MAX_XMP = 1 << 20
# The largest side that libpng decodes.
_MAX_SIDE = 1_000_000
# The formats of the supported suffixes. PIL recognises a file by its content, and has decoders that
# run other programs.
_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP")

_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_BASE, _IFD = ExifTags.Base, ExifTags.IFD
FULL_FRAME_DIAGONAL_MM = 43.27
# Accepted focal lengths divided by the longer side: from a 180 degree lens to a 35 mm equivalent
# of 700 mm.
_FOCAL_RANGE = (0.25, 20.0)
# Relative difference of aspect ratios above which an image was cropped; rounding causes less.
CROPPED = 0.02
# The same for focal lengths from the focal plane resolution, which programs often leave unchanged
# when they resize an image.
_FOCAL_PLANE_RANGE = (0.3, 4.0)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


class FileFacts(BaseModel):
    """Metadata of an image file; see ``manifest.Photo`` for the fields.

    Attributes:
        gps_fault: The reason why a GPS position in the metadata is not used.
        colours_fault: The reason why the colours are used as sRGB although the file says something
            else; empty otherwise.
    """

    model_config = ConfigDict(frozen=True)

    digest: str
    width: int
    height: int
    linear: bool = False
    alpha: bool = False
    bits: int = 8
    orientation: int = 1
    body: str = ""
    lens: str = ""
    focal_mm: float | None = None
    focal_px: float | None = None
    gps: Position | None = None
    gps_fault: Fault | None = None
    taken: str | None = None
    panorama: Panorama = "no"
    colours: str = ""
    colours_fault: str = ""

    @property
    def camera_group(self) -> str:
        size = f"{self.width}x{self.height}"
        if not (self.body or self.lens or self.focal_mm):
            return size
        focal = f"{self.focal_mm:g} mm" if self.focal_mm else "?"
        return " | ".join([self.body or "?", self.lens or "?", focal, size])


def read_facts(path: Path) -> FileFacts:
    """Read a photograph's header and, if it has one, its alpha channel.

    Raises:
        UserError: the file cannot be read, or is not an image in a supported format.
    """
    try:
        if os.stat(path).st_size > MAX_BYTES:
            raise ValueError(f"its file is larger than {MAX_BYTES >> 30} GiB")
        digest = digest_of(path)
        suffix = suffix_of(path.name)
        if suffix in RAW_SUFFIXES:
            return _raw_facts(path, digest)
        if suffix in exr.EXR_SUFFIXES:
            return _exr_facts(path, digest)
        with _quiet(), opened_image(path, path.name) as image:
            width, height = _stored_size(image)
            if _bits(image) > 16:
                raise ValueError("more than 16 bits a channel; convert it to 8 or 16")
            xmp = _xmp(image)
            tags = _exif_of(lambda: _header_exif(image))
            exif, colours = _exif_facts(tags, width, height, xmp), colours_of(image, tags)
            return FileFacts(
                digest=digest,
                width=width,
                height=height,
                alpha=_has_transparency(image),
                bits=_bits(image),
                panorama=panorama_of(xmp, exif["body"], width, height),
                colours=colours.name,
                colours_fault=colours.fault,
                **exif,
            )
    except UnidentifiedImageError:
        reason = f"no header of its format found ({', '.join(_formats(path.name))})"
    except OSError as error:
        reason = error.strerror or str(error)
    except MemoryError:
        reason = "its header asks for more memory than there is"
    # PIL and LibRaw raise exceptions of many types on damaged files.
    except Exception as error:
        reason = str(error) or type(error).__name__
    raise UserError(
        f"cannot be read as a photograph: {reason}",
        file=path,
        fix="replace the file by an intact copy, or remove it from the folder",
    )


def opened_image(file: Path | IO[bytes], name: str) -> Image.Image:
    """An image file, opened by PIL; its pixels are not decoded yet.

    Args:
        file: A path, or its bytes.
        name: The name of the file; its suffix decides which formats are tried.

    Raises:
        OSError: The file is no image of these formats.
        ValueError: The image has too many pixels; PIL's exceptions of any type for damaged files.
    """
    pillow_formats.register(suffix_of(name))
    image = Image.open(file, formats=_formats(name))
    try:
        check_size(*image.size)
        _check_decoded(image)
        _check_whole(image)
    except ValueError:
        image.close()
        raise
    return image


def colours_of_file(image: Image.Image) -> Colours:
    """The colours of an image that was opened by ``opened_image``."""
    with _quiet():
        return colours_of(image, _exif_of(lambda: _header_exif(image)))


def _stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height of the stored pixels; PIL's are those of a TIFF after its orientation."""
    tags = getattr(image, "tag_v2", None)
    if image.format != "TIFF" or tags is None:
        return image.size
    return int(tags[_TIFF_WIDTH]), int(tags[_TIFF_HEIGHT])


def check_size(width: int, height: int) -> None:
    """Raises: ValueError: more pixels than a photograph or a video has."""
    if max(width, height) > _MAX_SIDE:
        raise ValueError(f"{width}x{height} pixels: a side of more than {_MAX_SIDE}; reduce it")
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"{width}x{height} pixels are more than {MAX_PIXELS // 10**6} megapixels; reduce it"
        )


def _check_decoded(image: Image.Image) -> None:
    """Check the memory that decoding takes, which some decoders need several times."""
    width, height = image.size
    per_pixel = _DECODER_BYTES.get(image.format or "", 0)
    if width * height * per_pixel > _MAX_DECODED:
        raise ValueError(
            f"{width}x{height} pixels of {image.format} take more than {_MAX_DECODED >> 20} MiB to "
            "decode; reduce it, or save it as JPEG"
        )


def _check_whole(image: Image.Image) -> None:
    """Check that a TIFF or BMP file is large enough for its pixels, and has all parts of them: PIL
    takes the missing ones for black."""
    tiles = getattr(image, "tile", [])
    if image.format not in ("TIFF", "BMP") or not tiles:
        return
    file = getattr(image, "fp", None)
    pixels = image.width * image.height
    covered = sum((right - left) * (low - top) for _, (left, top, right, low), *_ in tiles)
    if covered < pixels:
        raise ValueError("it lacks a part of its pixels: the file is truncated or damaged")
    if file is None or any(kind != "raw" for kind, *_ in tiles):
        return
    at = file.tell()
    size = file.seek(0, os.SEEK_END)
    file.seek(at)
    if pixels > 8 * size:  # One bit a pixel.
        raise ValueError(f"{image.width}x{image.height} pixels are more than its {size} bytes hold")


def _formats(name: str) -> tuple[str, ...]:
    suffix = suffix_of(name)
    return (pillow_formats.format_of(suffix),) if suffix in pillow_formats.SUFFIXES else _FORMATS


def _raw_facts(path: Path, digest: str) -> FileFacts:
    import rawpy  # Slow to import.

    try:
        with rawpy.imread(str(path)) as raw:
            width, height = int(raw.sizes.iwidth), int(raw.sizes.iheight)
            check_size(width, height)
            focal_mm, stamp = float(raw.other.focal_length), raw.other.timestamp
            lens = str(raw.lens.model).strip()
    except rawpy.LibRawError as error:
        details = [a.decode() if isinstance(a, bytes) else str(a) for a in error.args]
        raise ValueError(f"LibRaw: {' '.join(details)}") from None

    def load() -> Image.Exif:
        exif = Image.Exif()
        with open(path, "rb") as file:
            exif.load_from_fp(file)
        return exif

    facts = _exif_facts(_exif_of(load), width, height)
    # LibRaw also parses formats that are not TIFF, which PIL cannot.
    if facts["focal_mm"] is None and _plausible(focal_mm):
        facts["focal_mm"] = focal_mm
    if facts["taken"] is None and stamp.year > 1980:
        facts["taken"] = stamp.isoformat()
    facts["lens"] = facts["lens"] or lens
    return FileFacts(digest=digest, width=width, height=height, linear=True, bits=16, **facts)


def _exr_facts(path: Path, digest: str) -> FileFacts:
    with open(path, "rb") as file:
        header = exr.read_header(file)
    return FileFacts(
        digest=digest,
        width=header.width,
        height=header.height,
        linear=True,
        alpha=header.alpha,
        bits=16,
        colours="" if header.to_srgb is None else "EXR files with primaries of their own",
        colours_fault=header.fault,
    )


def _has_transparency(image: Image.Image) -> bool:
    """Whether any pixel is not opaque. Many files have an alpha channel that is 255 everywhere."""
    if "A" not in image.mode:
        return "transparency" in image.info
    try:
        return bool(np.asarray(image.getchannel("A")).min() < 255)
    except (OSError, SyntaxError, ValueError):
        return True  # Damaged pixels are reported when they are decoded.


def _bits(image: Image.Image) -> int:
    """Bits per channel as stored (PIL opens 16-bit RGB as 8-bit)."""
    tags = getattr(image, "tag_v2", None)
    if tags is not None:
        return int(max(tags.get(258, (8,))))
    tile = getattr(image, "tile", None)
    raw_mode = tile[0][3] if tile else ""
    raw_mode = raw_mode[0] if isinstance(raw_mode, tuple) else raw_mode
    return 16 if "16" in str(raw_mode) or "16" in image.mode or image.mode == "I" else 8


# --- EXIF ---------------------------------------------------------------------------------


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress PIL's warnings about damaged EXIF data, which is treated as missing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _xmp(image: Image.Image) -> bytes:
    """The header of the XMP packet stored before the pixels; empty without one."""
    found = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    return (found.encode("utf-8", "replace") if isinstance(found, str) else bytes(found))[:_MAX_XMP]


def _header_exif(image: Image.Image) -> Image.Exif:
    """EXIF data stored before the pixels; PIL's ``getexif`` would decode a whole PNG."""
    if image.format != "PNG":
        return image.getexif()
    exif = Image.Exif()
    exif.load(image.info.get("exif", b""))
    return exif


def _exif_of(load: Any) -> Mapping[int, Any]:
    """All tags, with those of the Exif and GPS directories; damaged data is omitted."""
    tags: dict[int, Any] = {}
    # PIL raises exceptions of many types on damaged EXIF data; the photograph is still usable.
    with contextlib.suppress(Exception), _quiet():
        exif = load()
        tags.update(exif)
        tags.update(exif.get_ifd(_IFD.Exif))
        tags[_IFD.GPSInfo] = dict(exif.get_ifd(_IFD.GPSInfo))
        tags[_IFD.Interop] = dict(exif.get_ifd(_IFD.Interop))
    return tags


def _exif_facts(
    tags: Mapping[int, Any], width: int, height: int, xmp: bytes = b""
) -> dict[str, Any]:
    orientation = tags.get(_BASE.Orientation, 1)
    make, model = _text(tags.get(_BASE.Make)), _text(tags.get(_BASE.Model))
    focal_mm = number_or_nan(tags.get(_BASE.FocalLength))
    gps = read_gps(tags.get(_IFD.GPSInfo) or {}, xmp)
    return {
        "orientation": orientation if orientation in range(1, 9) else 1,
        "body": _body(make, model),
        "lens": _text(tags.get(_BASE.LensModel)),
        "focal_mm": focal_mm if _plausible(focal_mm) else None,
        "focal_px": focal_pixels(tags, width, height),
        "gps": gps.position,
        "gps_fault": gps.fault,
        "taken": _taken(tags),
    }


def focal_pixels(tags: Mapping[int, Any], width: int, height: int) -> float | None:
    """Focal length in pixels at ``width`` x ``height``, or None if EXIF does not give it.

    It follows from the 35 mm equivalent, which compares diagonals (CIPA DCG-001), else from the
    focal length in mm and the pixel pitch (FocalPlaneXResolution) at the size stored in EXIF. If
    the aspect ratio differs from EXIF's, the image was cropped by an unknown amount: None.
    """
    longer = max(width, height)
    taken_width = number_or_nan(tags.get(_BASE.ExifImageWidth))
    taken_height = number_or_nan(tags.get(_BASE.ExifImageHeight))
    if not (_plausible(taken_width) and _plausible(taken_height)):
        taken_width, taken_height = width, height
    taken_longer, taken_shorter = max(taken_width, taken_height), min(taken_width, taken_height)
    if abs(taken_longer / taken_shorter * min(width, height) / longer - 1) > CROPPED:
        return None
    equivalent = number_or_nan(tags.get(_BASE.FocalLengthIn35mmFilm))
    if _plausible(equivalent):
        focal = equivalent / FULL_FRAME_DIAGONAL_MM * math.hypot(width, height)
        if _FOCAL_RANGE[0] <= focal / longer <= _FOCAL_RANGE[1]:
            return focal
    focal_mm = number_or_nan(tags.get(_BASE.FocalLength))
    resolution = number_or_nan(tags.get(_BASE.FocalPlaneXResolution))
    unit = _MM_PER_UNIT.get(tags.get(_BASE.FocalPlaneResolutionUnit, 2), 25.4)
    if _plausible(focal_mm) and _plausible(resolution):
        focal = focal_mm * resolution / unit * longer / taken_longer
        if _FOCAL_PLANE_RANGE[0] <= focal / longer <= _FOCAL_PLANE_RANGE[1]:
            return focal
    return None


def _plausible(value: float) -> bool:
    return math.isfinite(value) and value > 0


def _body(make: str, model: str) -> str:
    """Make and model without repeating the make: "NIKON CORPORATION" and "NIKON D60" give
    "NIKON D60"."""
    brand = make.split(" ")[0].casefold()
    return model if model.casefold().startswith(brand) else f"{make} {model}".strip()


def _text(value: Any) -> str:
    """``value`` without control characters and other ones that cannot be printed."""
    return "".join(c for c in value if c.isprintable()).strip() if isinstance(value, str) else ""


def _taken(tags: Mapping[int, Any]) -> str | None:
    for tag in (_BASE.DateTimeOriginal, _BASE.DateTimeDigitized):
        try:
            moment = datetime.datetime.strptime(_text(tags.get(tag)), "%Y:%m:%d %H:%M:%S")
        except ValueError:
            continue
        digits = _text(tags.get(_BASE.SubsecTimeOriginal))
        fraction = f".{digits[:6]}" if digits.isascii() and digits.isdecimal() else ""
        return moment.isoformat() + fraction
    return None
