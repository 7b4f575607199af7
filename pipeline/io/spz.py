"""SPZ files: Niantic's compressed format for Gaussians, versions 1 to 4.

Coordinates are in the format's own axes (right, up, back), and are converted from and to the
world's. The containers are in ``spz_container``. Source of the encoding of the attributes:
github.com/nianticlabs/spz, README.md. Quantisation errors: docs/reference/formats.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.io.bounded import read_bounded
from pipeline.io.splat_codec import FIX, logit_of_byte, sigmoid, to_uint8
from pipeline.io.spz_container import (
    ANTIALIASED,
    HAS_EXTENSIONS,
    HIGHER,
    MAX_GAUSSIANS,
    Header,
    pack,
    read_header,
    unpack,
)
from pipeline.runtime.atomic import write_pieces
from pipeline.runtime.errors import UserError
from pipeline.splats.arrays import GaussianSource
from pipeline.splats.axes import RUB, Flipped, flip
from pipeline.splats.gaussians import Gaussians

Doubles = NDArray[np.float64]

# Quantisation steps per unit of the DC coefficient, as in Niantic's encoder; 8 bits then cover
# colours beyond [0, 1]. Higher coefficients are written with all 8 bits; other encoders keep 5 or 4
# to compress better.
_DC_STEPS = 0.15 * 255
# Positions have 24 bits; the maximum number of fractional bits.
_MAX_FRACTION_BITS = 20
# Gaussians farther from the origin than this many median distances are outliers: they are moved
# nearer, so that the other positions keep their resolution.
_OUTLIER_DISTANCE = 512.0
# The range of log scales: 8 bits in steps of 1/16.
_LOG_SCALES = (-10.0, 255 / 16 - 10)
_QUAT_STEPS = 511 * np.sqrt(2.0)  # The three smaller components are at most 1 / sqrt(2).
_FIX = "write the file again as SPZ version 3 or 4, or get an intact copy of it"


def write_spz(
    path: Path, gaussians: GaussianSource, *, antialias: bool = False, version: int = 3
) -> None:
    """Write an SPZ file atomically; see ``encode_spz``."""
    write_pieces(path, _pieces(gaussians, antialias, version))


def read_spz(path: Path) -> Gaussians:
    """Read an SPZ file; see ``decode_spz``.

    Raises:
        UserError: the file cannot be read or is not a valid SPZ file.
    """
    return decode_spz(read_bounded(path, fix=FIX), file=path)


def read_antialias(path: Path) -> bool:
    """Whether an SPZ file records that the Gaussians were trained with opacity compensation; False
    for a file that cannot be read."""
    found = read_header(path)
    return found is not None and bool(found.flags & ANTIALIASED)


def ignored_content(path: Path) -> list[str]:
    """What ``read_spz`` leaves out of an SPZ file, in words."""
    found, ignored = read_header(path), []
    if found is not None and found.degree == len(HIGHER) - 1:
        ignored.append("spherical harmonics of degree 4 (3 is the highest that is rendered)")
    if found is not None and found.flags & HAS_EXTENSIONS:
        ignored.append("extensions of the format other than the axes")
    return ignored


def encode_spz(gaussians: GaussianSource, *, antialias: bool = False, version: int = 3) -> bytes:
    """The bytes of an SPZ file; the same Gaussians always give the same bytes.

    Args:
        gaussians: The Gaussians in the world's axes.
        antialias: Whether the Gaussians were trained with Mip-Splatting's opacity compensation,
            with which viewers should render them.
        version: The version of the format, 3 or 4.

    Raises:
        UserError: The version is another, or cannot hold so many Gaussians (``MAX_GAUSSIANS``).
    """
    return b"".join(_pieces(gaussians, antialias, version))


def _pieces(gaussians: GaussianSource, antialias: bool, version: int) -> Iterator[bytes]:
    if version not in (3, 4):
        raise UserError(
            f"expected SPZ version 3 or 4, found {version}", fix="write one of these versions"
        )
    count, limit = len(gaussians), MAX_GAUSSIANS[version]
    if count > limit:
        other = ", write version 4 (spz4 in export.formats)" if count <= MAX_GAUSSIANS[4] else ""
        raise UserError(
            f"an SPZ file of version {version} can hold up to {limit} Gaussians, found {count}",
            fix="export fewer of the faint Gaussians (experiments.export.min_opacity)"
            f"{other}, or write a PLY",
        )
    bits = _fraction_bits(gaussians)
    header = Header(version, count, gaussians.sh_degree, bits, ANTIALIASED * antialias)
    return pack(header, _attributes(Flipped(gaussians, RUB), bits))


def _attributes(gaussians: GaussianSource, bits: int) -> list[Iterator[bytes]]:
    """The bytes of each attribute, chunk by chunk."""

    def attribute(encode: Callable[..., NDArray[np.uint8]], *names: str) -> Iterator[bytes]:
        for chunk in gaussians.chunks(*names):
            yield encode(*(values.astype(np.float64) for values in chunk)).tobytes()

    def positions(means: Doubles) -> NDArray[np.uint8]:
        steps = np.rint(means * _shrink(means, bits) * 2.0**bits).astype("<i4")
        return steps.reshape(-1, 1).view(np.uint8)[:, :3]

    def scales(means: Doubles, log_scales: Doubles) -> NDArray[np.uint8]:
        return to_uint8((log_scales + np.log(_shrink(means, bits)) + 10) * 16)

    return [
        attribute(positions, "means"),
        attribute(lambda logits: to_uint8(sigmoid(logits) * 255), "opacity_logits"),
        attribute(lambda sh: to_uint8(sh[:, 0] * _DC_STEPS + 127.5), "sh"),
        attribute(scales, "means", "log_scales"),
        attribute(_pack_quats, "quats"),
        attribute(lambda sh: to_uint8(sh[:, 1:] * 128 + 128), "sh"),
    ]


def count_out_of_range(gaussians: GaussianSource) -> int:
    """The number of Gaussians whose largest scale is outside SPZ's range, or smaller than half a
    quantisation step of the positions."""
    bits, count = _fraction_bits(gaussians), 0
    least = max(_LOG_SCALES[0], -(bits + 1) * np.log(2.0))
    for chunk in gaussians.chunks("means", "log_scales"):
        means, log_scales = (values.astype(np.float64) for values in chunk)
        longest = log_scales.max(axis=1, initial=-np.inf) + np.log(_shrink(means, bits)[:, 0])
        count += int(((longest < least) | (longest > _LOG_SCALES[1])).sum())
    return count


def share_of_clamped_harmonics(gaussians: GaussianSource) -> float:
    """The share of Gaussians with a spherical harmonic that SPZ's 8 bits cannot hold: one above
    degree 0 outside of [-1, 1], or a colour far outside of [0, 1]."""
    clamped = 0
    for (sh,) in gaussians.chunks("sh"):
        dc = (np.abs(sh[:, :1]) > (127.5 + 0.5) / _DC_STEPS).any(axis=(1, 2))
        clamped += int((dc | (np.abs(sh[:, 1:]) > 1).any(axis=(1, 2))).sum())
    return clamped / max(1, len(gaussians))


def decode_spz(data: bytes, file: str | Path | None = None) -> Gaussians:
    """The Gaussians in the bytes of an SPZ file, version 1 to 4, in the world's axes.

    SH degree 4 is reduced to 3, and extensions other than the one that names the axes are ignored.
    Opacities of exactly 0 and 1, whose logits are infinite, are clamped by a quarter of a
    quantisation step.

    Args:
        file: The file that error messages name.

    Raises:
        UserError: The file is not SPZ, another version, truncated, or inconsistent with its header.
    """
    try:
        header, attributes, axes = unpack(data)
    except ValueError as error:
        raise UserError(str(error), file=file, fix=_FIX) from None
    positions, alphas, dc, scales, quats, rest = attributes
    count, higher = header.number, HIGHER[header.degree]
    sh = np.empty((count, min(higher, HIGHER[3]) + 1, 3), np.float32)
    sh[:, 0] = (dc - np.float32(127.5)) / np.float32(_DC_STEPS)
    sh[:, 1:] = (rest.reshape(count, higher, 3)[:, : sh.shape[1] - 1] - np.float32(128)) / 128
    if header.version == 1:
        means = positions.view("<f2").astype(np.float64)
    else:
        means = _unpack_positions(positions) * 2.0**-header.fraction_bits
    arrays: dict[str, NDArray[Any]] = {
        "means": means,
        "log_scales": scales / 16.0 - 10,
        "quats": (_unpack_quats if header.version >= 3 else _unpack_quats_v2)(quats),
        "opacity_logits": logit_of_byte(alphas[:, 0]),
        "sh": sh,
    }
    return Gaussians.from_arrays(flip(arrays, axes))


def _fraction_bits(gaussians: GaussianSource) -> int:
    """The number of fractional bits of the positions, as many as the scene's size allows."""
    distance = np.zeros(len(gaussians))
    start = 0
    for (means,) in gaussians.chunks("means"):
        distance[start : start + len(means)] = _distance(means)
        start += len(means)
    reach = 0.0
    if len(distance):
        reach = min(distance.max(), _OUTLIER_DISTANCE * float(np.median(distance)))
    integer_bits = int(np.ceil(np.log2(reach))) if reach > 0 else 0
    return int(np.clip(23 - integer_bits, 0, _MAX_FRACTION_BITS))


def _shrink(means: Doubles, bits: int) -> Doubles:
    """(N, 1) factors of positions and scales, 1 except for outliers. Scaling both leaves an
    outlier's appearance from the origin unchanged."""
    limit = (2**23 - 1) * 2.0**-bits
    return np.asarray(limit / np.maximum(_distance(means), limit))[:, None]


def _distance(means: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.abs(means).max(axis=1, initial=0.0))


def _unpack_positions(fixed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(N, 9) bytes to (N, 3) signed 24-bit integers."""
    padded = np.zeros((len(fixed), 3, 4), np.uint8)
    padded[:, :, 1:] = fixed.reshape(-1, 3, 3)
    return (padded.view("<i4")[:, :, 0] >> 8).astype(np.float64)


def _pack_quats(quats: Doubles) -> NDArray[np.uint8]:
    """(N, 4) wxyz to (N, 4) bytes: 2 bits with the index of the largest component, then a sign bit
    and 9 bits of magnitude for each of the other three (in the order xyzw, highest bits first)."""
    norm = np.linalg.norm(quats, axis=1, keepdims=True)
    q = np.where(norm > 0, quats / np.where(norm > 0, norm, 1), (1.0, 0, 0, 0))[:, [1, 2, 3, 0]]
    largest = np.abs(q).argmax(1)
    rows = np.arange(len(q))
    # q and -q are the same rotation, so the omitted component is made positive.
    q = np.where(q[rows, largest, None] < 0, -q, q)
    magnitude = np.rint(np.abs(q) * _QUAT_STEPS).clip(0, 511).astype(np.uint32)
    code = magnitude | ((q < 0).astype(np.uint32) << np.uint32(9))
    packed = largest.astype("<u4")
    for part in range(4):
        packed = np.where(part == largest, packed, packed << np.uint32(10) | code[:, part])
    return packed.astype("<u4").reshape(-1, 1).view(np.uint8)


def _unpack_quats(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The inverse of ``_pack_quats``."""
    left = np.ascontiguousarray(packed).view("<u4")[:, 0]
    largest = left >> np.uint32(30)
    q = np.zeros((len(left), 4))
    for part in (3, 2, 1, 0):
        stored = part != largest
        value = (left & np.uint32(511)) / _QUAT_STEPS
        q[:, part] = np.where(stored, np.where(left & np.uint32(512), -value, value), 0)
        left = np.where(stored, left >> np.uint32(10), left)
    q[np.arange(len(q)), largest] = np.sqrt(np.maximum(0, 1 - (q * q).sum(1)))
    return q[:, [3, 0, 1, 2]]


def _unpack_quats_v2(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(N, 3) bytes of xyz (SPZ versions 1 and 2) to (N, 4) wxyz."""
    xyz = packed / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(1, keepdims=True)))
    return np.concatenate([w, xyz], 1)
