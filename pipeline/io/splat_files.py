"""Files of Gaussians by their suffix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch

from pipeline.io.gltf import read_gltf, write_gltf
from pipeline.io.ply import read_splat_ply, write_splat_ply
from pipeline.io.splat import read_splat, write_splat
from pipeline.io.spz import read_spz, write_spz
from pipeline.runtime.errors import UserError
from pipeline.splats.gaussians import Gaussians

_READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".ply": read_splat_ply,
    ".spz": read_spz,
    ".splat": read_splat,
    ".glb": read_gltf,
    ".npz": Gaussians.load,
}
_WRITERS: dict[str, Callable[[Path, Gaussians], None]] = {
    ".ply": write_splat_ply,
    ".spz": write_spz,
    ".splat": write_splat,
    ".glb": write_gltf,
    ".npz": lambda path, gaussians: gaussians.save(path),
}
T = TypeVar("T")
SUFFIXES = tuple(_READERS)
# Of infinite logarithms and logits: e^30 and e^-30 are as good as infinite and nothing.
_HUGE = 30.0


def read_gaussians(path: Path, warnings: list[str]) -> Gaussians:
    """Read Gaussians from a file of any known format, ready to be rendered.

    Flat Gaussians (log scale minus infinity) and full opacity (logit infinity) are made finite.
    Gaussians with values that are no numbers, or without a rotation, are left out and add a
    warning.

    Raises:
        UserError: an unknown suffix, a file that cannot be read, or nothing in it to render.
    """
    gaussians = _by_suffix(_READERS, path)(path)
    tamed = {
        name: tensor.nan_to_num(nan=torch.nan, posinf=_HUGE, neginf=-_HUGE)
        for name, tensor in gaussians.tensors().items()
        if name in ("log_scales", "opacity_logits")
    }
    gaussians = Gaussians(**(gaussians.tensors() | tamed))
    whole = (gaussians.quats != 0).any(1)
    for tensor in gaussians.tensors().values():
        whole &= tensor.flatten(1).isfinite().all(1) if tensor.ndim > 1 else tensor.isfinite()
    if not whole.any():
        raise UserError(
            f"expected Gaussians, found none that can be rendered (of {len(gaussians)})",
            file=path,
            fix="export the model again",
        )
    if not whole.all():
        left_out = int((~whole).sum())
        warnings.append(
            f"{path}: {left_out} of {len(whole)} Gaussians hold values that are no numbers, or no "
            "rotation; they are left out"
        )
        gaussians = gaussians.select(whole)
    return gaussians


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians in the format that the suffix names; the file appears whole or not at all.

    Raises:
        UserError: an unknown suffix, or Gaussians the format cannot hold.
    """
    _by_suffix(_WRITERS, path)(path, gaussians)


def check_suffix(path: Path) -> None:
    """Raise a ``UserError`` where ``path`` has no suffix of a known format."""
    _by_suffix(_WRITERS, path)


def _by_suffix(table: dict[str, T], path: Path) -> T:
    suffix = path.suffix.lower()
    if suffix not in table:
        raise UserError(
            f"expected a file of Gaussians ({', '.join(table)}), found the suffix {suffix!r}",
            file=path,
            fix="give the file one of these suffixes",
        )
    return table[suffix]
