"""Headers of PLY files (Turk 1994): the properties of the first element, ``vertex``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pipeline.io.splat_codec import FIX
from pipeline.runtime.errors import UserError

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
#: The comment that records Mip-Splatting's opacity compensation, in brush's words, which
#: splat-transform reads. Postshot has others.
ANTIALIASED = "comment SplatRenderMode: mip"
_ANTIALIASED = (ANTIALIASED.split(), ["comment", "antialiased", "1"])
# The limit in bytes: headers have fewer than a hundred lines; a longer one is of another format.
_MAX_HEADER = 1 << 16
# More digits are no number of vertices, and slow to convert.
_MAX_DIGITS = 15


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file whose first element is ``vertex``.

    Attributes:
        count: The number of vertices.
        fields: The name of each property -> numpy's code of its type.
        byte_order: The sign "<" or ">"; "" for ASCII.
        more: Whether other elements follow.
        antialiased: Whether a comment records that the Gaussians were trained with Mip-Splatting's
            opacity compensation.
    """

    count: int
    fields: dict[str, str]
    byte_order: str
    more: bool
    antialiased: bool = False


def wrong(path: Path, what: str) -> UserError:
    """The error for a file that is not the PLY file that was expected."""
    return UserError(what, file=path, fix=FIX)


def read_header(file: BinaryIO, path: Path) -> PlyHeader:
    """Read the header of a PLY file, up to the first byte of its body.

    Raises:
        UserError: The file is not a PLY file whose first element is ``vertex``.
    """
    lines: list[list[str]] = []
    size = 0
    while not lines or lines[-1] != ["end_header"]:
        line = file.readline(_MAX_HEADER)
        size += len(line)
        if not lines and line.rstrip() != b"ply":
            raise wrong(path, f"expected a PLY file, found one that begins with {line[:16]!r}")
        if not line.endswith(b"\n") or size > _MAX_HEADER:
            raise wrong(path, "expected a PLY header, found no end of it (end_header)")
        lines.append(line.decode("ascii", "replace").split())
    byte_order = None
    elements: list[tuple[str, str]] = []
    fields: dict[str, str] = {}
    for words in lines[1:-1]:
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", kind, "1.0"] if kind in _BYTE_ORDERS:
                byte_order = _BYTE_ORDERS[kind]
            case ["element", "chunk", _]:
                raise UserError(
                    "expected an ordinary PLY file, found SuperSplat's compressed one",
                    file=path,
                    fix="convert it to an ordinary PLY file, as with splat-transform",
                )
            case ["element", name, count]:
                elements.append((name, count))
            case ["property", kind, name] if kind in _TYPES and elements:
                if len(elements) == 1:
                    if name in fields:
                        raise wrong(path, f"expected each property once, found {name} twice")
                    fields[name] = _TYPES[kind]
            case ["property", "list", _, _, _] if len(elements) > 1:
                pass
            case _:
                raise wrong(path, f"expected a PLY header line, found {' '.join(words)[:80]!r}")
    if byte_order is None:
        raise wrong(path, "expected a format line in the PLY header, found none")
    count = elements[0][1] if elements and elements[0][0] == "vertex" else ""
    if not count.isdecimal() or len(count) > _MAX_DIGITS:
        raise wrong(path, "expected 'element vertex COUNT' as the first element, found none")
    antialiased = any(words in _ANTIALIASED for words in lines)
    return PlyHeader(int(count), fields, byte_order, len(elements) > 1, antialiased)
