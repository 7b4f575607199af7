"""Files of Gaussians, and warnings."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from os import PathLike
from pathlib import Path

from pipeline.io import splat_files
from pipeline.splats.gaussians import Gaussians


def read_gaussians(file: str | PathLike[str]) -> Gaussians:
    """Read Gaussians from a .ply, .spz, .sog, .splat, .glb or .npz file.

    Raises:
        UserError: The suffix is unknown, or the file cannot be read.
    """
    found: list[str] = []
    gaussians = splat_files.read_gaussians(Path(file), found)
    warn(found)
    return gaussians


def write_gaussians(
    file: str | PathLike[str], gaussians: Gaussians, *, spz_version: int = 3
) -> None:
    """Write Gaussians as they are, in the format of the file's suffix. A warning names what the
    format does not hold. ``Scene.export`` writes those of a scene in the unit of its poses.

    Args:
        spz_version: The version of an SPZ file, 3 or 4.

    Raises:
        UserError: The suffix is unknown, or the format cannot hold the Gaussians.
    """
    warn(splat_files.write_gaussians(Path(file), gaussians, spz_version=spz_version))


def warn(messages: Iterable[str]) -> None:
    """Issue Python warnings at the line that called the caller of this function."""
    for message in messages:
        warnings.warn(message, stacklevel=3)
