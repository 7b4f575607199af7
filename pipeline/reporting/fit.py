"""Reduces Gaussians to the size limit of a report page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.io.splat_codec import sigmoid
from pipeline.io.spz import encode_spz
from pipeline.splats.arrays import GaussianArrays, GaussianRows, collect
from pipeline.splats.axes import RUB, Flipped
from pipeline.splats.levels import merged_to

# Size of the sample from which the compressed size is estimated, and a safety factor.
_SAMPLE = 20_000
_MARGIN = 0.95


MAX_GAUSSIANS = 200_000
"""The largest number of Gaussians in a page: more take long to appear."""

FIRST_GAUSSIANS = 30_000
"""The number of merged Gaussians that a page shows first, without view-dependent colours."""

# A page with at most this multiple of FIRST_GAUSSIANS shows all of its Gaussians at once.
_AT_ONCE = 2


@dataclass(frozen=True)
class Packed:
    """Gaussians as bytes of an SPZ file, with their number and SH degree.

    The file's coordinates are the world's, in which the viewer places cameras: they are not
    converted to SPZ's axes.

    Attributes:
        first: An SPZ file of the merged Gaussians that are shown until ``spz`` is decoded; None
            where ``spz`` has few Gaussians.
    """

    spz: bytes
    count: int
    sh_degree: int
    first: bytes | None = None


def fit(gaussians: GaussianArrays, centres: NDArray[np.float64], max_bytes: int) -> Packed:
    """Compress at most ``MAX_GAUSSIANS`` Gaussians to at most about ``max_bytes``.

    The size of ``Packed.first`` is included. Of more Gaussians, the most prominent are taken. Bands
    of spherical harmonics are dropped first, then the Gaussians of least prominence: at the same
    size, renders without SH are closer to those of the complete scene than renders of fewer
    Gaussians.

    Args:
        centres: (C, 3) camera centres, world.
        max_bytes: The size limit.
    """
    step = max(len(gaussians) // _SAMPLE, 1)
    sample, degree, number = np.arange(0, len(gaussians), step), gaussians.sh_degree, 0
    wanted = min(len(gaussians), MAX_GAUSSIANS)
    if wanted > _AT_ONCE * FIRST_GAUSSIANS:
        max_bytes -= int(FIRST_GAUSSIANS * len(_encode(gaussians, sample, 0)) / len(sample))
    for degree in range(gaussians.sh_degree, -1, -1):
        each = len(_encode(gaussians, sample, degree)) / len(sample)
        number = min(max(int(max_bytes * _MARGIN / each), 0), wanted)
        if number == wanted:
            break
    rows = np.arange(len(gaussians))
    in_steps = number > _AT_ONCE * FIRST_GAUSSIANS
    if not in_steps and number == len(rows):
        return Packed(_encode(gaussians, rows, degree), number, degree)
    prominences = prominence(gaussians, centres)
    if number < len(rows):
        rows = np.sort(np.argsort(-prominences, kind="stable")[:number])
    first = None
    if in_steps:
        first = _first(collect(GaussianRows(gaussians, rows, 0)), prominences[rows])
    return Packed(_encode(gaussians, rows, degree), len(rows), degree, first)


def _first(gaussians: GaussianArrays, prominences: NDArray[np.float32]) -> bytes:
    """``FIRST_GAUSSIANS`` merged Gaussians as an SPZ file.

    Args:
        gaussians: The Gaussians of the page, of SH degree 0.
        prominences: (N,) of these.
    """
    # Opacity times solid angle: what each adds to pictures.
    weights = np.maximum(prominences.astype(np.float64) ** 2, 1e-30)
    return encoded(merged_to(gaussians, FIRST_GAUSSIANS, weights))


def encoded(gaussians: GaussianArrays) -> bytes:
    """All Gaussians as an SPZ file in the coordinates of the page, as ``Packed``."""
    return _encode(gaussians, np.arange(len(gaussians)), gaussians.sh_degree)


def _encode(gaussians: GaussianArrays, rows: NDArray[np.intp], degree: int) -> bytes:
    # Flipping before the writer does keeps the world's coordinates.
    return encode_spz(Flipped(GaussianRows(gaussians, rows, degree), RUB))


def prominence(gaussians: GaussianArrays, centres: NDArray[np.float64]) -> NDArray[np.float32]:
    """(N,) opacity times the angle each Gaussian spans, as seen by the cameras.

    The angle is the square root of the product of the two longer axes and the mean of
    1 / distance^2.
    """
    # A sample of the cameras is enough.
    some = centres[:: max(len(centres) // 64, 1)].astype(np.float32)
    found = [np.zeros(0, np.float32)]
    for means, log_scales, logits in gaussians.chunks("means", "log_scales", "opacity_logits"):
        inverse = np.zeros(len(means), np.float32)
        for centre in some:
            inverse += 1 / np.maximum(((means - centre) ** 2).sum(1), np.float32(1e-12))
        longer = np.sort(log_scales, 1)[:, 1:].sum(1)
        angle = np.sqrt(np.exp(longer) * inverse / max(len(some), 1))
        found.append((sigmoid(logits) * angle).astype(np.float32))
    return np.concatenate(found)
