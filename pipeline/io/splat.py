""".splat files: 32 bytes per Gaussian without a header.

Position and linear scale are float32, colour and opacity 8 bits each, rotation wxyz in steps of
1/128. Spherical harmonics above degree 0 are not stored. Source: github.com/antimatter15/splat,
README.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.io.bounded import read_bounded
from pipeline.io.splat_codec import FIX, logit_of_byte, sigmoid, to_uint8
from pipeline.runtime.atomic import write_pieces
from pipeline.runtime.errors import UserError
from pipeline.splats.arrays import NAMES, Array, GaussianSource
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import SH_C0

_ROW = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgb", "u1", 3), ("alpha", "u1"), ("quat", "u1", 4)]
)


def write_splat(path: Path, gaussians: GaussianSource) -> None:
    """Write a .splat file atomically; colours are clamped to [0, 1]."""
    write_pieces(path, (_rows(*chunk).tobytes() for chunk in gaussians.chunks(*NAMES)))


def share_of_clamped_colours(gaussians: GaussianSource) -> float:
    """The share of Gaussians with a colour outside of [0, 1] by more than a step of 8 bits."""
    clamped = 0
    for (sh,) in gaussians.chunks("sh"):
        distance = np.abs(SH_C0 * sh[:, 0].astype(np.float64))
        clamped += int((distance > 0.5 + 1 / 255).any(axis=1).sum())
    return clamped / max(1, len(gaussians))


def _rows(means: Array, log_scales: Array, quats: Array, logits: Array, sh: Array) -> NDArray[Any]:
    norm = np.linalg.norm(quats, axis=1, keepdims=True)
    table = np.zeros(len(means), _ROW)
    table["mean"] = means
    table["scale"] = np.exp(log_scales)
    table["rgb"] = to_uint8((0.5 + SH_C0 * sh[:, 0]) * 255)
    table["alpha"] = to_uint8(sigmoid(logits) * 255)
    table["quat"] = to_uint8(quats / np.maximum(norm, 1e-12) * 128 + 128)
    return table


def read_splat(path: Path) -> Gaussians:
    """Read a .splat file as Gaussians of SH degree 0.

    The format has no header, so only the file's size and the range of values can be checked.

    Raises:
        UserError: the file is missing, has a size that is not a multiple of 32, or has values
            that are not finite or negative scales.
    """
    data = read_bounded(path, fix=FIX)
    if len(data) % _ROW.itemsize:
        what = f"expected a multiple of {_ROW.itemsize} bytes, found {len(data)}"
        raise UserError(what, file=path, fix=FIX)
    table = np.frombuffer(data, _ROW)
    if not np.isfinite(table["mean"]).all() or not (table["scale"] >= 0).all():
        what = "expected a .splat file, found impossible positions or scales"
        raise UserError(what, file=path, fix=FIX)
    with np.errstate(divide="ignore"):
        log_scales = np.log(table["scale"])
    return Gaussians.from_arrays(
        {
            "means": table["mean"],
            "log_scales": log_scales,
            "quats": table["quat"] / 128 - 1,
            "opacity_logits": logit_of_byte(table["alpha"]),
            "sh": ((table["rgb"] / 255 - 0.5) / SH_C0)[:, None],
        }
    )
