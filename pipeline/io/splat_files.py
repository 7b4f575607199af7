"""Reading and writing files of Gaussians; the suffix decides the format."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from pathlib import Path

from pipeline.io import usd
from pipeline.io.frame_json import Frame
from pipeline.io.gltf import read_gltf, write_gltf
from pipeline.io.npz import read_npz, write_npz
from pipeline.io.ply import is_antialiased_ply, read_splat_ply, write_splat_ply
from pipeline.io.sog import is_antialiased_sog, read_sog, write_sog
from pipeline.io.splat import read_splat, write_splat
from pipeline.io.splat_losses import losses, losses_of_reading, suffix_of_format, unmarked
from pipeline.io.spz import read_antialias, read_spz, write_spz
from pipeline.runtime.errors import UserError
from pipeline.splats.arrays import GaussianSource
from pipeline.splats.gaussians import Gaussians

_Format = tuple[Callable[[Path], Gaussians], Callable[[Path, GaussianSource], None]]
# The reader and the writer of each format.
_FORMATS: dict[str, _Format] = {
    ".ply": (read_splat_ply, write_splat_ply),
    ".spz": (read_spz, write_spz),
    ".sog": (read_sog, write_sog),
    ".splat": (read_splat, write_splat),
    ".glb": (read_gltf, write_gltf),
    ".npz": (read_npz, write_npz),
    usd.SUFFIX: (usd.refuse_usd, usd.write_usd),
}
#: The suffixes of files that are read and written.
SUFFIXES = tuple(suffix for suffix in _FORMATS if suffix != usd.SUFFIX)
# Replaces infinite logarithms and logits by finite ones; exp(-30) is negligible.
_LARGE = 30.0


def is_exported(path: Path) -> bool:
    """Whether a file of Gaussians is in the unit of the given poses, as exports and files of other
    programs are. The pipeline's own files are in the world that the scene was trained in."""
    return path.suffix.lower() != ".npz"


def read_gaussians(path: Path, warnings: list[str]) -> Gaussians:
    """Read Gaussians from a file in any supported format, ready for rendering.

    Infinite log scales (flat Gaussians) and opacity logits (full opacity) are made finite.
    Gaussians with NaN values or a zero quaternion are omitted with a warning, and so is what is
    not read of the format (``splat_losses``).

    Raises:
        UserError: An unknown suffix, a file that cannot be read, or no valid Gaussians.
    """
    read, _ = _format_of(path)
    gaussians = read(path)
    warnings += losses_of_reading(path)
    finite = {
        name: tensor.nan_to_num(nan=math.nan, posinf=_LARGE, neginf=-_LARGE)
        for name, tensor in gaussians.tensors().items()
        if name in ("log_scales", "opacity_logits")
    }
    gaussians = Gaussians(**(gaussians.tensors() | finite))
    valid = (gaussians.quats != 0).any(1)
    for tensor in gaussians.tensors().values():
        valid &= tensor.flatten(1).isfinite().all(1) if tensor.ndim > 1 else tensor.isfinite()
    if not valid.any():
        raise UserError(
            f"expected Gaussians, found none that can be rendered (of {len(gaussians)})",
            file=path,
            fix="export the model again",
        )
    if not valid.all():
        omitted = int((~valid).sum())
        warnings.append(
            f"{path}: {omitted} of {len(valid)} Gaussians have values that are not finite or a "
            "zero quaternion, and are left out"
        )
        gaussians = gaussians.select(valid)
    return gaussians


def write_gaussians(
    path: Path,
    gaussians: GaussianSource,
    *,
    antialias: bool = False,
    spz_version: int = 3,
) -> list[str]:
    """Write Gaussians atomically, in the format of the suffix.

    Args:
        antialias: Whether the Gaussians were trained with Mip-Splatting's opacity compensation.
        spz_version: The version of an SPZ file, 3 or 4.

    Returns:
        A sentence for everything that the format does not hold (``splat_losses``).

    Raises:
        UserError: An unknown suffix, or Gaussians that the format cannot hold.
    """
    _, write = _format_of(path)
    if write is write_spz:
        write_spz(path, gaussians, antialias=antialias, version=spz_version)
    elif write is write_sog:
        write_sog(path, gaussians, antialias=antialias)
    elif write is write_splat_ply:
        write_splat_ply(path, gaussians, antialias=antialias)
    else:
        write(path, gaussians)
    return [*losses(path, gaussians), *(unmarked([path.name]) if antialias else [])]


def is_antialiased(path: Path) -> bool:
    """Whether a file of Gaussians, or the ``frame.json`` of the export that it belongs to, records
    that they were trained with Mip-Splatting's opacity compensation."""
    suffix = suffix_of_format(path)
    if suffix == ".spz":
        return read_antialias(path)
    if suffix == ".sog":
        return is_antialiased_sog(path)
    if suffix == ".ply" and is_antialiased_ply(path):
        return True
    # Another program's file of this name describes none of our exports.
    with contextlib.suppress(UserError, OSError):
        return is_exported(path) and Frame.read(path.parent).render.antialias
    return False


def check_suffix(path: Path) -> None:
    """Raise a ``UserError`` if ``path`` has no suffix of a supported format."""
    _format_of(path)


def _format_of(path: Path) -> _Format:
    suffix = suffix_of_format(path)
    if suffix not in _FORMATS:
        raise UserError(
            f"expected a file of Gaussians ({', '.join(_FORMATS)}), found the suffix {suffix!r}",
            file=path,
            fix="give the file one of these suffixes",
        )
    return _FORMATS[suffix]
