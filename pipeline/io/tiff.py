"""The first directory of TIFF files: what decoders need to be told about the stored pixels.

OpenCV and Pillow apply the tag Orientation when they decode TIFF, and to no other format. Pixels
are used as stored, so the tag is set to 1 in the bytes that they decode.

Source: "TIFF Revision 6.0", 1992, section 2; BigTIFF as in libtiff.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_WIDTH, _HEIGHT, _BITS, _PHOTOMETRIC, _ORIENTATION = 256, 257, 258, 262, 274
_SAMPLES, _PLANAR, _EXTRA, _FORMAT = 277, 284, 338, 339
# Sizes in bytes and formats of the types of numbers: BYTE, SHORT, LONG, LONG8.
_TYPES = {1: (1, "B"), 3: (2, "H"), 4: (4, "I"), 16: (8, "Q")}
_MAX_ENTRIES, _MAX_VALUES = 4096, 16


@dataclass(frozen=True)
class TiffLayout:
    """How the pixels of the first image are stored.

    Attributes:
        width, height: The size as stored, in pixels.
        bits: The number of bits of the widest channel.
        samples: The number of channels.
        whole: Whether the values are unsigned integers.
        separate: Whether each channel is stored in a plane of its own.
        inverted: Whether 0 is white.
        premultiplied: Whether colours are multiplied by alpha.
        alpha: Whether the channel after the colours is alpha.
    """

    width: int
    height: int
    bits: int
    samples: int
    whole: bool
    separate: bool
    inverted: bool
    premultiplied: bool
    alpha: bool


def is_tiff(data: bytes) -> bool:
    """Whether these bytes begin as a TIFF file does."""
    return data[:4] in _MARKS


def layout_of(data: bytes) -> TiffLayout:
    """The layout of a TIFF file's first image.

    Raises:
        ValueError: The file's first directory is damaged.
    """
    tags = {tag: values for tag, (_, values) in _directory(data).items()}

    def first(tag: int, default: int) -> int:
        return tags.get(tag, (default,))[0]

    extra = tags.get(_EXTRA, ())
    return TiffLayout(
        width=first(_WIDTH, 0),
        height=first(_HEIGHT, 0),
        bits=max(tags.get(_BITS, (1,))),
        samples=first(_SAMPLES, 1),
        whole=set(tags.get(_FORMAT, (1,))) == {1},
        separate=first(_PLANAR, 1) == 2,
        inverted=first(_PHOTOMETRIC, 1) == 0,
        premultiplied=extra[:1] == (1,),
        alpha=extra[:1] in ((1,), (2,)),
    )


def without_orientation(data: bytes) -> bytes:
    """The same file with Orientation 1. A file whose directory is damaged is returned unchanged:
    its decoder reports the damage."""
    try:
        entry = _directory(data).get(_ORIENTATION)
    except ValueError:
        return data
    if entry is None or entry[1] == (1,):
        return data
    at, values = entry
    changed = bytearray(data)
    order = "<" if data[:1] == b"I" else ">"
    # Orientation is a SHORT. Other types are as wide as their values require.
    struct.pack_into(f"{order}{len(values)}{at[1]}", changed, at[0], *[1] * len(values))
    return bytes(changed)


def _directory(data: bytes) -> dict[int, tuple[tuple[int, str], tuple[int, ...]]]:
    """Tag -> the offset and the format of its values, and the values; only tags of a few whole
    numbers."""
    if not is_tiff(data):
        raise ValueError("not a TIFF file")
    order, big = ("<" if data[:1] == b"I" else ">"), b"+" in data[:4]
    offset, count, entry, inline = ("Q", "Q", 20, 8) if big else ("I", "H", 12, 4)
    try:
        (start,) = struct.unpack_from(order + offset, data, 8 if big else 4)
        (entries,) = struct.unpack_from(order + count, data, start)
        start += struct.calcsize(order + count)
        found: dict[int, tuple[tuple[int, str], tuple[int, ...]]] = {}
        for number in range(min(entries, _MAX_ENTRIES)):
            at = start + entry * number
            tag, kind = struct.unpack_from(f"{order}HH", data, at)
            (length,) = struct.unpack_from(order + offset, data, at + 4)
            size, code = _TYPES.get(kind, (0, ""))
            if not size or not 1 <= length <= _MAX_VALUES:
                continue
            at += entry - inline
            if size * length > inline:
                (at,) = struct.unpack_from(order + offset, data, at)
            values = struct.unpack_from(f"{order}{length}{code}", data, at)
            found.setdefault(tag, ((at, code), values))
    except (struct.error, OverflowError):
        raise ValueError("its first directory is damaged") from None
    return found
