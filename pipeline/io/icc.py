"""ICC profiles of RGB images that consist of three curves and a matrix: written from primaries, and
read for images of 16 bits, which Pillow's colour management cannot convert.

Source: ICC.1:2022 "Image technology colour management", sections 7.2, 9.2, 10.6, 10.15, 10.18.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Chromaticities = tuple[
    tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]
]
"""CIE xy of red, green, blue and white."""
Curve = tuple[float, ...]
"""Parameters of a ``para`` curve from stored values to linear light: gamma alone, or g, a, b, c, d:
(a x + b)^g from d on, c x below."""

D65 = (0.3127, 0.3290)
SRGB: Chromaticities = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), D65)
DISPLAY_P3: Chromaticities = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), D65)
DCI_P3: Chromaticities = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), (0.314, 0.351))
ADOBE_RGB: Chromaticities = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), D65)
BT2020: Chromaticities = ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), D65)
SRGB_CURVE: Curve = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)

# White of the profile connection space.
_D50 = np.array([0.9642, 1.0, 0.8249])
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
# Number of parameters of each type of ``para`` curve.
_PARAMETERS = (1, 3, 4, 5, 7)
_LEVELS = 65536


@dataclass(frozen=True)
class MatrixProfile:
    """A profile of curves and a matrix.

    Attributes:
        matrix: The (3, 3) matrix from linear RGB to CIE XYZ, white at D50.
        curves: The (3, 65536) float32 linear light of each 16-bit value.
    """

    matrix: NDArray[np.float64]
    curves: NDArray[np.float32]


def matrix_of(chromaticities: Chromaticities) -> NDArray[np.float64]:
    """(3, 3) linear RGB with these primaries to CIE XYZ, adapted to a white of D50 (Bradford).

    Raises:
        ValueError: No colours have these chromaticities.
    """
    xy = np.array(chromaticities, np.float64)
    if xy.shape != (4, 2) or not np.isfinite(xy).all() or np.abs(xy[:, 1]).min() < 1e-3:
        raise ValueError("impossible chromaticities")
    columns = np.stack([xy[:, 0] / xy[:, 1], np.ones(4), (1 - xy.sum(axis=1)) / xy[:, 1]])
    primaries, white = columns[:, :3], columns[:, 3]
    if abs(np.linalg.det(primaries)) < 1e-6:
        raise ValueError("impossible chromaticities")
    matrix = primaries * np.linalg.solve(primaries, white)
    response = (_BRADFORD @ _D50) / (_BRADFORD @ white)
    adapted = np.linalg.solve(_BRADFORD, np.diag(response) @ _BRADFORD) @ matrix
    if not np.isfinite(adapted).all() or np.abs(adapted).max() > 100:
        raise ValueError("impossible chromaticities")
    return np.asarray(adapted)


def write_profile(name: str, chromaticities: Chromaticities, curve: Curve) -> bytes:
    """An ICC profile (version 4) of a display with these primaries and one curve.

    Raises:
        ValueError: See ``matrix_of``.
    """
    matrix = matrix_of(chromaticities)
    kind = _PARAMETERS.index(len(curve))
    curve_tag = b"para" + struct.pack(">4xH2x", kind) + _fixed(curve)
    tags = {
        b"desc": _text(name),
        b"cprt": _text("no copyright"),
        b"wtpt": _xyz(_D50),
        **{tag: _xyz(matrix[:, i]) for i, tag in enumerate((b"rXYZ", b"gXYZ", b"bXYZ"))},
        **dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve_tag),
    }
    table, body = struct.pack(">I", len(tags)), b""
    start = 128 + 4 + 12 * len(tags)
    for tag, data in tags.items():
        data += b"\0" * (-len(data) % 4)
        table += tag + struct.pack(">II", start + len(body), len(data))
        body += data
    header = struct.pack(">I4xI", start + len(body), 0x04300000) + b"mntrRGB XYZ "
    header = header.ljust(36, b"\0") + b"acsp"
    header = header.ljust(68, b"\0") + _fixed(_D50)
    return header.ljust(128, b"\0") + table + body


def read_profile(data: bytes) -> MatrixProfile | None:
    """The curves and the matrix of an RGB or grey profile; None for profiles that consist of
    tables, and for damaged ones."""
    try:
        tags = _tags(data)
        if any(tag[:3] == b"A2B" for tag in tags):
            return None
        if data[16:20] == b"GRAY":
            curve = _curve(tags[b"kTRC"])
            # Equal channels: any matrix of this white does.
            return MatrixProfile(matrix_of(SRGB), np.stack([curve] * 3))
        columns = [struct.unpack(">3i", tags[t][8:20]) for t in (b"rXYZ", b"gXYZ", b"bXYZ")]
        curves = [_curve(tags[tag]) for tag in (b"rTRC", b"gTRC", b"bTRC")]
    except (struct.error, KeyError, ValueError, IndexError):
        return None
    return MatrixProfile(np.array(columns, np.float64).T / 65536, np.stack(curves))


def _tags(data: bytes) -> dict[bytes, bytes]:
    (count,) = struct.unpack_from(">I", data, 128)
    tags = {}
    for number in range(min(count, 100)):
        tag, start, length = struct.unpack_from(">4sII", data, 132 + 12 * number)
        tags[tag] = data[start : start + length]
    return tags


def _curve(tag: bytes) -> NDArray[np.float32]:
    """(65536,) linear light of each 16-bit value."""
    x = np.linspace(0, 1, _LEVELS)
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        table = np.frombuffer(tag, ">u2", count, 12)
        if count == 0:
            light = x
        elif count == 1:
            light = x ** (table[0] / 256)
        else:
            light = np.interp(x, np.linspace(0, 1, count), table / 65535)
    elif tag[:4] == b"para":
        light = _parametric(x, tag)
    else:
        raise ValueError("no curve")
    if not np.isfinite(light).all():
        raise ValueError("a curve without values")
    return np.clip(light, 0, 1).astype(np.float32)


def _parametric(x: NDArray[np.float64], tag: bytes) -> NDArray[np.float64]:
    (kind,) = struct.unpack_from(">H", tag, 8)
    values = struct.unpack_from(f">{_PARAMETERS[kind]}i", tag, 12)
    g, a, b, c, d, e, f = [*(value / 65536 for value in values), *[0.0] * 7][:7]
    if kind == 0:
        a, edge, low = 1.0, 0.0, np.zeros_like(x)
    elif kind < 3:
        offset, c = (c, 0.0) if kind == 2 else (0.0, 0.0)
        e, edge, low = offset, (-b / a if a else 0.0), np.full_like(x, offset)
    else:
        e, edge, low = (e, d, c * x + f) if kind == 4 else (0.0, d, c * x)
    with np.errstate(all="ignore"):
        high = np.maximum(a * x + b, 0) ** g + e
    return np.where(x >= edge, high, low)


def _fixed(values: Sequence[float] | NDArray[np.float64]) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(float(value) * 65536) for value in values))


def _xyz(values: NDArray[np.float64]) -> bytes:
    return b"XYZ \0\0\0\0" + _fixed(values)


def _text(text: str) -> bytes:
    data = text.encode("utf-16-be")
    return b"mluc" + struct.pack(">4xII4sII", 1, 12, b"enUS", len(data), 28) + data
