"""The Gaussians: five arrays of one length, and how they are kept on disk."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.runtime.errors import UserError
from pipeline.splats.arrays import write_arrays
from pipeline.splats.init import InitGaussians

FIX = "delete it and run again"


@dataclass
class Gaussians:
    """Structure of arrays, float32, contiguous, on the CPU.

    Attributes:
        means: (N, 3) centres in the world.
        log_scales: (N, 3) natural logarithm of the standard deviations.
        quats: (N, 4) wxyz, not necessarily of unit length.
        opacity_logits: (N,) inverse sigmoid of the opacity.
        sh: (N, K, 3) spherical harmonics, K = (degree + 1)^2, coefficient 0 is the constant.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    opacity_logits: Tensor
    sh: Tensor

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1

    def tensors(self) -> dict[str, Tensor]:
        """The arrays by name, in the order of the fields; not copies."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def parameters(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The arrays in the order of the fields, the rasterizer's first five arguments."""
        return self.means, self.log_scales, self.quats, self.opacity_logits, self.sh

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """The same as numpy arrays that share the memory."""
        return {name: tensor.numpy() for name, tensor in self.tensors().items()}

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray] | InitGaussians) -> Gaussians:
        """Copies of numpy arrays named as the fields."""
        if isinstance(arrays, InitGaussians):
            arrays = arrays.arrays()
        return Gaussians(
            *(
                torch.from_numpy(np.array(arrays[field.name], np.float32, order="C"))
                for field in fields(Gaussians)
            )
        )

    def select(self, rows: Tensor) -> Gaussians:
        """Copies of the rows named by a boolean mask (N,) or by int64 indices (M,)."""
        return Gaussians(*(tensor[rows].contiguous() for tensor in self.tensors().values()))

    def clone(self) -> Gaussians:
        return Gaussians(*(tensor.clone() for tensor in self.tensors().values()))

    def with_sh_degree(self, degree: int) -> Gaussians:
        """The same Gaussians with higher SH bands cut off, or added as zeros."""
        return Gaussians(
            self.means,
            self.log_scales,
            self.quats,
            self.opacity_logits,
            resize_bands(self.sh, degree),
        )

    def save(self, path: Path) -> None:
        """Write a ``.npz`` file; the same Gaussians always give the same bytes."""
        write_arrays(path, self.arrays())

    @staticmethod
    def load(path: Path) -> Gaussians:
        """Read what ``save`` wrote.

        Raises:
            UserError: the file is missing, damaged, or holds something else.
        """
        try:
            with np.load(path) as archive:
                gaussians = Gaussians.from_arrays({name: archive[name] for name in archive.files})
            n, k = gaussians.means.shape[0], (min(gaussians.sh_degree, 3) + 1) ** 2
        except (
            *(OSError, ValueError, KeyError, IndexError, EOFError, TypeError),
            *(zipfile.BadZipFile, zlib.error),
        ) as error:
            raise UserError(
                f"expected a file of Gaussians, could not read it: {error}", file=path, fix=FIX
            ) from error
        shapes = {name: tuple(tensor.shape) for name, tensor in gaussians.tensors().items()}
        wanted = {
            "means": (n, 3),
            "log_scales": (n, 3),
            "quats": (n, 4),
            "opacity_logits": (n,),
            "sh": (n, k, 3),
        }
        if shapes != wanted:
            raise UserError(
                f"the arrays of Gaussians do not belong together: {shapes}",
                file=path,
                fix=FIX,
            )
        return gaussians


def concat(parts: list[Gaussians]) -> Gaussians:
    """All rows of ``parts``, one after the other; their SH degrees are the same."""
    return Gaussians(
        *(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Gaussians))
    )


def resize_bands(sh: Tensor, degree: int) -> Tensor:
    """(N, K, 3) cut or filled with zeros to (N, (degree + 1)^2, 3), contiguous."""
    bands = (degree + 1) ** 2
    if bands <= sh.shape[1]:
        return sh[:, :bands].contiguous()
    return torch.cat([sh, sh.new_zeros(len(sh), bands - sh.shape[1], 3)], 1)
