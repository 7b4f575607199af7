"""SOG files (Spatially Ordered Gaussians): PlayCanvas's compressed format, version 2.

Coordinates are those of PLY files. Positions have 16 bits over the range of their signed
logarithms, scales and colours are indices into codebooks of 256 values, rotations and opacities
have 8 bits a number, and higher spherical harmonics are an index into a palette. Source:
developer.playcanvas.com, "The SOG Format". Quantisation errors: docs/reference/formats.md.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.io.codebook import make_codebook, nearest_entries
from pipeline.io.palette import make_palette
from pipeline.io.sog_container import (
    CENTROIDS_PER_ROW,
    HIGHER,
    META,
    Asset,
    Bytes,
    Coded,
    Harmonics,
    Means,
    Meta,
    Quats,
    decode_image,
    encode_image,
    pack,
    read_files,
    write_folder,
)
from pipeline.io.splat_codec import logit_of_byte, sigmoid, to_uint8
from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.errors import UserError
from pipeline.splats.arrays import Array, GaussianSource, collect
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.levels import weights_of

Doubles = NDArray[np.float64]
Triple = tuple[float, float, float]

_STEPS = (1 << 16) - 1  # Between the least and the largest position.
_MAX_PALETTE = 1 << 16
_FEW = 512  # The centroids of so many Gaussians take few bytes.
# The alpha of rotations is this plus the index (wxyz) of the largest component. The others are at
# most 1 / sqrt(2).
_TAG = 252
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
# Replaces infinite logarithms by finite ones; exp(-30) is negligible.
_LARGE = 30.0
_FIX = "write the file again as SOG version 2, or get an intact copy of it"


def write_sog(path: Path, gaussians: GaussianSource, *, antialias: bool = False) -> None:
    """Write a SOG file atomically, or, if ``path`` is named ``meta.json``, a folder of files; see
    ``encode_sog``."""
    files = encode_sog(gaussians, antialias=antialias)
    if path.name.lower() == META:
        write_folder(path, files)
    else:
        write_bytes(path, pack(files))


def read_sog(path: Path) -> Gaussians:
    """Read a SOG file, or the folder of a file ``meta.json``.

    Opacities of exactly 0 and 1, whose logits are infinite, are clamped by a quarter of a
    quantisation step.

    Raises:
        UserError: The file cannot be read, is not SOG, another version, or inconsistent.
    """
    try:
        meta, files = read_files(path)
        return _decode(meta, files)
    except ValueError as error:
        raise UserError(str(error), file=path, fix=_FIX) from None


def is_antialiased_sog(path: Path) -> bool:
    """Whether a SOG file records that the Gaussians were trained with opacity compensation; False
    for a file that cannot be read."""
    try:
        return read_files(path)[0].antialias
    except (ValueError, UserError):
        return False


def count_small(gaussians: GaussianSource) -> int:
    """The number of Gaussians that are smaller than half of a quantisation step of their
    position."""
    low, high, count = np.full(3, np.inf), np.full(3, -np.inf), 0
    for (means,) in gaussians.chunks("means"):
        logs = _signed_logs(means)
        low, high = np.minimum(low, logs.min(0)), np.maximum(high, logs.max(0))
    for means, log_scales in gaussians.chunks("means", "log_scales"):
        steps = (1 + np.abs(means.astype(np.float64))) * (high - low) / _STEPS
        count += int((np.exp(log_scales.max(1)) < steps.max(1) / 2).sum())
    return count


def encode_sog(gaussians: GaussianSource, *, antialias: bool = False) -> dict[str, bytes]:
    """The files of a SOG folder by name; the same Gaussians always give the same bytes.

    The order of the Gaussians is kept. Gaussians in Morton order are written in fewer bytes.

    Args:
        gaussians: The Gaussians in the world's axes.
        antialias: Whether the Gaussians were trained with Mip-Splatting's opacity compensation.

    Raises:
        UserError: There are no Gaussians, which the format cannot express.
    """
    if not len(gaussians):
        raise UserError("expected Gaussians, found none", fix="use another model")
    arrays = collect(gaussians)
    log_scales, colours = arrays.log_scales.clip(-_LARGE, _LARGE), arrays.sh[:, 0]
    scale_codes, colour_codes = make_codebook(log_scales), make_codebook(colours)
    low, high, steps = _encode_means(arrays.means)
    opacities = to_uint8(sigmoid(arrays.opacity_logits) * 255)
    images = {
        "means_l.webp": (steps & 255).astype(np.uint8),
        "means_u.webp": (steps >> 8).astype(np.uint8),
        "scales.webp": nearest_entries(scale_codes, log_scales),
        "quats.webp": _encode_quats(arrays.quats),
        "sh0.webp": np.column_stack([nearest_entries(colour_codes, colours), opacities]),
    }
    harmonics = None
    if arrays.sh_degree:
        harmonics, images["shN_labels.webp"], centroids = _encode_harmonics(
            arrays.sh[:, 1:], weights_of(arrays)
        )
    count = len(arrays)
    width = 4 * max(1, math.ceil(math.sqrt(count) / 4))
    files = {name: encode_image(_pixels(values, width)) for name, values in images.items()}
    if harmonics is not None:
        files["shN_centroids.webp"] = encode_image(centroids)
    meta = Meta(
        version=2,
        asset=Asset(generator="splatmake"),
        count=count,
        antialias=antialias,
        means=Means(mins=low, maxs=high, files=("means_l.webp", "means_u.webp")),
        scales=Coded(codebook=scale_codes.tolist(), files=("scales.webp",)),
        quats=Quats(files=("quats.webp",)),
        sh0=Coded(codebook=colour_codes.tolist(), files=("sh0.webp",)),
        shN=harmonics,
    )
    return {META: meta.model_dump_json(exclude_none=True).encode(), **files}


def _pixels(values: Bytes, width: int) -> Bytes:
    """(height, width, 4) pixels with a row of (N, up to 4) ``values`` each. Alpha is opaque where
    the values have none."""
    count, channels = values.shape
    pixels = np.zeros((width * max(1, math.ceil(count / width)), 4), np.uint8)
    pixels[:, 3] = 255
    pixels[:count, :channels] = values
    return pixels.reshape(-1, width, 4)


def _encode_means(means: Array) -> tuple[Triple, Triple, NDArray[np.uint16]]:
    """The least and largest signed logarithm of each coordinate, and (N, 3) steps between them."""
    logs = _signed_logs(means)
    low, high = logs.min(0), logs.max(0)
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1) * _STEPS)
    return _triple(low), _triple(high), steps.astype(np.uint16)


def _signed_logs(means: Array) -> Doubles:
    logs: Doubles = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    return logs


def _triple(values: Doubles) -> Triple:
    x, y, z = values.tolist()
    return x, y, z


def _encode_quats(quats: Array) -> Bytes:
    """(N, 4) wxyz to (N, 4) bytes: three components without the largest, and which it is."""
    norm = np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    q = np.where(norm > 0, quats / np.where(norm > 0, norm, 1), (1.0, 0, 0, 0))
    largest = np.abs(q).argmax(1)[:, None]
    # q and -q are the same rotation, so the omitted component is made positive.
    q = np.where(np.take_along_axis(q, largest, 1) < 0, -q, q)
    others = np.take_along_axis(q, _OTHERS[largest[:, 0]], 1)
    return np.column_stack([to_uint8((others / math.sqrt(2) + 0.5) * 255), _TAG + largest]).astype(
        np.uint8
    )


def _encode_harmonics(higher: Array, weights: Doubles) -> tuple[Harmonics, Bytes, Bytes]:
    """The description of the palette, (N, 2) bytes of the labels, and the image of the centroids.

    Args:
        higher: (N, K - 1, 3) coefficients above degree 0.
        weights: (N,) weights of the errors of the Gaussians.
    """
    count, coefficients = higher.shape[:2]
    # As many centroids as PlayCanvas's writer has, a power of two; one for each Gaussian of a few.
    size = min(_MAX_PALETTE, 1 << (count.bit_length() - 1)) if count > _FEW else count
    palette = make_palette(higher.reshape(count, -1), weights, size)
    codebook = make_codebook(palette.centroids)
    codes = nearest_entries(codebook, palette.centroids).reshape(-1, 3)
    harmonics = Harmonics(
        count=len(palette.centroids),
        bands=HIGHER.index(coefficients),
        codebook=codebook.tolist(),
        files=("shN_centroids.webp", "shN_labels.webp"),
    )
    labels = palette.labels.astype("<u2").view(np.uint8).reshape(count, 2)
    return harmonics, labels, _pixels(codes, CENTROIDS_PER_ROW * coefficients)


def _decode(meta: Meta, files: dict[str, bytes]) -> Gaussians:
    """Raises: ValueError: see ``read_sog``."""
    count = meta.count

    def image(name: str) -> Bytes:
        return decode_image(files[name], name, count)[:count]

    low, high = (image(name)[:, :3] for name in meta.means.files)
    quats, scales, colours = (image(part.files[0]) for part in (meta.quats, meta.scales, meta.sh0))
    sh = np.empty((count, HIGHER[meta.degree] + 1, 3), np.float32)
    sh[:, 0] = _coded(meta.sh0.codebook, colours[:, :3], meta.sh0.files[0])
    if meta.shN is not None:
        sh[:, 1:] = _decode_harmonics(meta.shN, files, image(meta.shN.files[1]))
    return Gaussians.from_arrays(
        {
            "means": _decode_means(meta.means, low, high),
            "log_scales": _coded(meta.scales.codebook, scales[:, :3], meta.scales.files[0]),
            "quats": _decode_quats(quats),
            "opacity_logits": logit_of_byte(colours[:, 3]),
            "sh": sh,
        }
    )


def _decode_means(means: Means, low: Bytes, high: Bytes) -> Doubles:
    steps = low.astype(np.uint16) | high.astype(np.uint16) << 8
    least, largest = np.array(means.mins), np.array(means.maxs)
    logs = least + (largest - least) * (steps / _STEPS)
    return np.sign(logs) * np.expm1(np.abs(logs))


def _decode_quats(pixels: Bytes) -> Doubles:
    """The inverse of ``_encode_quats``; pixels without a valid tag are the identity."""
    rows = np.arange(len(pixels))
    largest = pixels[:, 3].astype(np.int64) - _TAG
    valid = largest >= 0
    largest = np.where(valid, largest, 0)
    others = (pixels[:, :3] / 255.0 - 0.5) * math.sqrt(2)
    q = np.zeros((len(pixels), 4))
    np.put_along_axis(q, _OTHERS[largest], np.where(valid[:, None], others, 0), 1)
    q[rows, largest] = np.sqrt(np.maximum(0, 1 - (q * q).sum(1)))
    return q


def _decode_harmonics(harmonics: Harmonics, files: dict[str, bytes], labels: Bytes) -> Array:
    """(N, K - 1, 3) coefficients above degree 0."""
    coefficients, name = HIGHER[harmonics.bands], harmonics.files[0]
    width = CENTROIDS_PER_ROW * coefficients
    rows = math.ceil(harmonics.count / CENTROIDS_PER_ROW)
    codes = decode_image(files[name], name, rows * width, width)[:, :3]
    used = codes[: harmonics.count * coefficients]
    centroids = _coded(harmonics.codebook, used, name).reshape(-1, coefficients, 3)
    found = labels[:, 0].astype(np.int64) | labels[:, 1].astype(np.int64) << 8
    if found.max() >= len(centroids):
        raise ValueError(
            f"{harmonics.files[1]}: expected indices of {len(centroids)} centroids, found "
            f"{found.max()}"
        )
    return centroids[found]


def _coded(codebook: tuple[float, ...], indices: Bytes, name: str) -> Array:
    """The values of a codebook at ``indices``."""
    if indices.max() >= len(codebook):
        raise ValueError(
            f"{name}: expected indices of {len(codebook)} values, found {indices.max()}"
        )
    with np.errstate(over="ignore"):
        return np.array(codebook).astype(np.float32)[indices]
