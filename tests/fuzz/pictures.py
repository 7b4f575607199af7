"""Masks, depth maps, and what files say about the orientation and the colours of their pixels."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import tifffile
from PIL import Image, ImageCms

from pipeline.io import icc
from pipeline.io.colour import to_srgb
from pipeline.io.depth_header import read_depth_header
from pipeline.io.photofile import read_facts
from pipeline.photos.load import load_depth, read_depth, read_mask, read_picture
from pipeline.runtime.errors import UserError
from tests.fuzz.packing import pack_png, pack_zip, unpack_zip
from tests.fuzz.reader import Files, Reader, of_file, same

WIDTH, HEIGHT = 24, 16
_FORMATS = {".jpg": "JPEG", ".png": "PNG", ".tif": "TIFF", ".webp": "WEBP"}
_XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    b'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
    b'xmlns:tiff="http://ns.adobe.com/tiff/1.0/" tiff:Orientation="8"/></rdf:RDF></x:xmpmeta>'
)


def noise(channels: int = 3, dtype: type = np.uint8) -> np.ndarray:
    shape = (HEIGHT, WIDTH, channels) if channels > 1 else (HEIGHT, WIDTH)
    return np.random.default_rng(channels).integers(0, np.iinfo(dtype).max, shape, dtype)


def encoded(pixels: np.ndarray, suffix: str) -> bytes:
    """The file that OpenCV writes."""
    done, data = cv2.imencode(suffix, pixels)
    assert done
    return data.tobytes()


def saved(image: Image.Image, kind: str, **options: object) -> bytes:
    """The file that Pillow writes."""
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def tiff(pixels: np.ndarray, **options: object) -> bytes:
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, pixels, metadata=None, **options)  # type: ignore[arg-type]
    return buffer.getvalue()


def pack_checked(data: bytes) -> bytes:
    """Give PNG chunks and archives of numpy correct checksums; other files stay as they are."""
    return pack_png(data) if data[1:4] == b"PNG" else data


# --- masks --------------------------------------------------------------------------------


def mask_seeds() -> Sequence[Files]:
    valid = noise(1) > 99
    levels, grey = np.where(valid, 255, 0).astype(np.uint8), Image.fromarray(valid)
    found: list[Files] = [
        {f"m{suffix}": encoded(levels, suffix)} for suffix in (".png", ".jpg", ".tif", ".bmp")
    ]
    found += [
        {"m.png": saved(grey, "PNG")},
        {"m.png": saved(Image.fromarray(levels).convert("P"), "PNG", transparency=0)},
        {"m.png": saved(Image.fromarray(levels).convert("LA"), "PNG")},
        {"m.png": encoded(np.dstack([levels, levels, levels, 255 - levels]), ".png")},
        {"m.png": encoded(levels.astype(np.uint16) * 257, ".png")},
        {"m.tif": tiff(levels, photometric="miniswhite")},
        {"m.webp": saved(Image.fromarray(levels).convert("RGBA"), "WEBP", lossless=True)},
    ]
    return found


def check_mask(file: Path) -> object:
    mask = read_mask(file)
    assert mask.valid.dtype == bool and mask.valid.ndim == 2
    return mask


# --- orientation --------------------------------------------------------------------------


def oriented_seeds() -> Sequence[Files]:
    found: list[Files] = []
    for number, (suffix, kind) in enumerate(_FORMATS.items()):
        exif = Image.Exif()
        exif[0x0112] = 5 + number
        options = {"exif": exif, "xmp": _XMP} if kind != "PNG" else {"exif": exif}
        found.append({f"x{suffix}": saved(Image.fromarray(noise()), kind, **options)})
    tag = [(274, 3, 1, 6, True)]
    layouts = [
        tiff(noise(3, np.uint16), photometric="rgb", extratags=tag),
        tiff(
            np.moveaxis(noise(3, np.uint16), 2, 0),
            photometric="rgb",
            planarconfig="separate",
            extratags=tag,
        ),
        tiff(noise(4, np.uint16), photometric="rgb", extrasamples=["assocalpha"], extratags=tag),
        tiff(noise(1, np.uint16), photometric="miniswhite", extratags=tag, bigtiff=True),
        tiff(noise(1), photometric="minisblack", extratags=tag, byteorder=">", rowsperstrip=3),
        tiff(noise(), photometric="rgb", extratags=tag, tile=(16, 16)),
    ]
    return found + [{"x.tif": data} for data in layouts]


def check_size(file: Path) -> object:
    """The size in the header is that of the pixels, whatever the orientation."""
    facts = read_facts(file)
    assert facts.orientation in range(1, 9)
    pixels = read_picture(file)
    assert pixels.shape[:2] == (facts.height, facts.width)
    return pixels


# --- colours ------------------------------------------------------------------------------


def profiles() -> list[bytes]:
    """ICC profiles of colours, grey and CIE L*a*b*."""
    grey = bytearray(icc.write_profile("grey", icc.SRGB, (2.2,)))
    grey[16:20] = b"GRAY"
    grey[:] = bytes(grey).replace(b"rTRC", b"kTRC")
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    return [
        icc.write_profile("Display P3", icc.DISPLAY_P3, icc.SRGB_CURVE),
        icc.write_profile("Adobe RGB", icc.ADOBE_RGB, (563 / 256,)),
        ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
        bytes(grey),
        lab,
    ]


def with_profile(profile: bytes) -> bytes:
    """A picture with this profile; its format and channels follow from the profile's bytes."""
    choice = zlib.crc32(profile) % 6
    if choice == 0:
        return tiff(noise(3, np.uint16), photometric="rgb", iccprofile=profile)
    if choice == 1:
        return tiff(noise(1, np.uint16), photometric="minisblack", iccprofile=profile)
    mode = {2: "L", 3: "CMYK"}.get(choice, "RGB")
    pixels = noise({"L": 1, "CMYK": 4}.get(mode, 3))
    kind = "JPEG" if mode == "CMYK" or len(profile) > 2**15 else ("PNG", "JPEG")[choice % 2]
    return saved(Image.fromarray(pixels, mode), kind, icc_profile=profile)


def profile_of(picture: bytes) -> bytes:
    """The profile in a file of ``with_profile``."""
    with Image.open(io.BytesIO(picture)) as image:
        return bytes(image.info.get("icc_profile", b""))


def coloured_seeds() -> Sequence[Files]:
    found: list[Files] = [{"x.png": with_profile(profile)} for profile in profiles()]
    # These are PNG's own chunks: primaries, gamma, code points.
    plain = encoded(np.full((HEIGHT, WIDTH, 3), 99, np.uint8), ".png")
    chunks = {
        b"gAMA": struct.pack(">I", 55556),
        b"cHRM": struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000),
        b"cICP": bytes((12, 13, 0, 1)),
    }
    for names in ((b"gAMA", b"cHRM"), (b"cICP",)):
        extra = b"".join(
            struct.pack(">I", len(chunks[name])) + name + chunks[name] + bytes(4) for name in names
        )
        found.append({"x.png": pack_png(plain[:33] + extra + plain[33:])})
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 2
    return [*found, {"x.jpg": saved(Image.fromarray(noise()), "JPEG", exif=exif)}]


def check_colours(file: Path) -> object:
    facts = read_facts(file)
    assert len(facts.colours) < 100 and facts.colours.isprintable()
    assert len(facts.colours_fault) < 200 and facts.colours_fault.isprintable()
    picture = read_picture(file)
    assert picture.dtype in (np.uint8, np.uint16)
    return picture


def read_profile(file: Path) -> object:
    """The profile's own reader, for the pixels that Pillow does not convert."""
    from pipeline.io.colour import Colours

    data = file.read_bytes()
    found = icc.read_profile(data)
    if found is not None:
        assert np.isfinite(found.curves).all() and found.matrix.shape == (3, 3)
        to_srgb(noise(3, np.uint16), Colours(data, "fuzzed"))
    if found is None:
        raise UserError("no profile of curves and a matrix")
    return found


# --- depth maps ---------------------------------------------------------------------------


def depth_seeds() -> Sequence[Files]:
    depth = 1 + np.random.default_rng(0).random((HEIGHT, WIDTH)).astype(np.float32)
    whole = (1000 * depth).astype(np.uint16)
    array, archive = io.BytesIO(), io.BytesIO()
    np.save(array, depth)
    np.savez_compressed(archive, depth=depth)
    return [
        {"d.npy": array.getvalue()},
        {"d.npz": archive.getvalue()},
        {"d.png": encoded(whole, ".png")},
        {"d.tif": tiff(depth, compression="zlib")},
        {"d.tif": tiff(whole)},
    ]


def unpack_depth(data: bytes) -> bytes:
    return b"PK" + unpack_zip(data) if data[:2] == b"PK" else data


def pack_depth(data: bytes) -> bytes:
    return pack_zip(data[2:]) if data[:2] == b"PK" else pack_checked(data)


def check_depth(file: Path) -> object:
    header = read_depth_header(file)
    stored = read_depth(file)
    if header is not None and stored.ndim >= 2:
        assert (header.height, header.width) == stored.shape[:2]
    return load_depth(file, stored.shape[1] / stored.shape[0] if stored.ndim > 1 else 1.0)


def profile_seeds() -> Sequence[Files]:
    return [{"x.icc": data} for data in profiles()[:4]]


PICTURES: dict[str, Reader] = {
    "mask": Reader(mask_seeds, of_file(check_mask), same, pack_checked),
    "orientation": Reader(oriented_seeds, of_file(check_size), same, pack_checked),
    "colour": Reader(coloured_seeds, of_file(check_colours), same, pack_checked, weight=0.5),
    "colour-profile": Reader(
        lambda: [{"x.png": with_profile(profile)} for profile in profiles()],
        of_file(check_colours),
        profile_of,
        with_profile,
        weight=0.5,
    ),
    "icc": Reader(profile_seeds, of_file(read_profile), weight=0.3),
    "depth": Reader(depth_seeds, of_file(check_depth), unpack_depth, pack_depth),
}
