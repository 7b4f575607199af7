"""The parameters of a scene's Gaussians, as tensors. Importing this module does not import torch:
the stages that write files handle ``arrays.GaussianArrays``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.splats.arrays import Array, GaussianArrays
from pipeline.splats.rows import take_rows

if TYPE_CHECKING:
    from torch import Tensor

COLORS = "sh", "appearance"


@dataclass
class Geometry:
    """All parameters of N Gaussians but their colours, see ``Gaussians``."""

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    opacity_logits: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name, in the order of the fields. They are not copied."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def select(self, rows: Tensor, threads: int = 1) -> Geometry:
        """Copies of the rows of int64 indices (M,)."""
        return Geometry(**take_rows(self.tensors(), rows, threads))


@dataclass
class Gaussians:
    """Parameters of N Gaussians: contiguous float32 tensors on the CPU.

    Attributes:
        means: (N, 3) centres in world coordinates.
        log_scales: (N, 3) natural logarithm of the standard deviations along the Gaussian's axes,
            in world units.
        quats: (N, 4) rotations from the Gaussian's axes to the world, as quaternions (wxyz), not
            necessarily normalised.
        opacity_logits: (N,) logits: the opacity is their sigmoid.
        sh: (N, K, 3) spherical harmonics of R, G and B, K = (degree + 1)^2, ordered and signed as
            in 3DGS; coefficient 0 is the constant (DC).
        appearance: (N, K, 3), added to SH coefficient 0 in proportion to the K numbers of a
            photograph's appearance embedding (``training.appearance``); None without a model of
            appearance. Only training has it.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    opacity_logits: Tensor
    sh: Tensor
    appearance: Tensor | None = None

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,} of SH degree {self.sh_degree})"

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def tensors(self) -> dict[str, Tensor]:
        """The tensors that are not None by name, in the order of the fields. They are not
        copied."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: tensor for name, tensor in found.items() if tensor is not None}

    def parameters(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The rasterizer's first arguments, in order."""
        return self.means, self.log_scales, self.quats, self.opacity_logits, self.sh

    @property
    def geometry(self) -> Geometry:
        """The parameters but the colours. They are not copied."""
        return Geometry(self.means, self.log_scales, self.quats, self.opacity_logits)

    def colors(self) -> dict[str, Tensor]:
        """The tensors by name that ``geometry`` does not have. They are not copied."""
        return {name: tensor for name, tensor in self.tensors().items() if name in COLORS}

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """The tensors as numpy arrays that share their memory."""
        return {name: tensor.numpy() for name, tensor in self.tensors().items()}

    def as_arrays(self) -> GaussianArrays:
        """The same Gaussians, without ``appearance``, in numpy arrays that share their memory."""
        return GaussianArrays(**replace(self, appearance=None).arrays())

    def chunks(self, *names: str) -> Iterator[list[Array]]:
        """See ``arrays.GaussianSource``."""
        return self.as_arrays().chunks(*names)

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray] | GaussianArrays) -> Gaussians:
        """Gaussians with copies of numpy arrays, which are named as the fields."""
        if isinstance(arrays, GaussianArrays):
            arrays = arrays.arrays()
        import torch

        names = [field.name for field in fields(Gaussians) if field.name in arrays]
        return Gaussians(
            **{n: torch.from_numpy(np.array(arrays[n], np.float32, order="C")) for n in names}
        )

    @staticmethod
    def sharing(arrays: GaussianArrays) -> Gaussians:
        """Gaussians that share the memory of contiguous arrays."""
        import torch

        return Gaussians(*(torch.from_numpy(array) for array in arrays.arrays().values()))

    def select(self, which: Tensor, threads: int = 1) -> Gaussians:
        """Copies of the Gaussians selected by a boolean mask (N,) or int64 indices (M,)."""
        import torch

        rows = torch.nonzero(which)[:, 0] if which.dtype == torch.bool else which
        return Gaussians(**take_rows(self.tensors(), rows, threads))

    def first(self, count: int) -> Gaussians:
        """The first Gaussians, in tensors that share their memory with these."""
        return Gaussians(**{k: v[:count] for k, v in self.tensors().items()})

    def clone(self) -> Gaussians:
        """The same Gaussians with copies of all tensors."""
        return Gaussians(**{k: v.clone() for k, v in self.tensors().items()})

    def with_sh_degree(self, degree: int) -> Gaussians:
        """The Gaussians with SH bands removed, or zeros added, to reach ``degree``."""
        return replace(self, sh=resize_bands(self.sh, degree))


def concat(parts: list[Gaussians]) -> Gaussians:
    """Concatenate Gaussians of the same SH degree."""
    import torch

    tensors = [part.tensors() for part in parts]
    return Gaussians(**{name: torch.cat([part[name] for part in tensors]) for name in tensors[0]})


def resize_bands(sh: Tensor, degree: int) -> Tensor:
    """Truncate or zero-pad (N, K, ...) coefficients to (N, (degree + 1)^2, ...), contiguous."""
    import torch

    bands = (degree + 1) ** 2
    if bands <= sh.shape[1]:
        return sh[:, :bands].contiguous()
    return torch.cat([sh, sh.new_zeros(len(sh), bands - sh.shape[1], *sh.shape[2:])], 1)
