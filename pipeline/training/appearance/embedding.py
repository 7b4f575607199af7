"""Appearance embeddings: the colours of the Gaussians in each photograph.

Photograph i has an embedding w_i of K numbers, as in NeRF in the Wild (Martin-Brualla et al. 2021),
and each Gaussian has K colours a_k. In the render of photograph i, the constant SH coefficient of a
Gaussian is

    sh_0 + sum_k w_ik a_k.

WildGaussians (Kulhanek et al. 2024) maps the embedding and features of the Gaussian to its colours
by a network; this is the linear case. A render is linear in the embedding, except where colours are
clamped at 0, so that the embedding of a new photograph is a small least squares problem (``fit``).

Only sums w_ik a_k are determined. At the end of training, the mean of the embeddings is moved into
sh_0: the scene's own colours are those of the mean photograph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render import AdamRates, Backend, Moments
from pipeline.scene.appearance import Appearance
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import SH_C0
from pipeline.training.optimisers.per_camera_adam import PerCameraAdam

Array = NDArray[np.float64]

# Upper limit of the total change of a number of an embedding. The numbers that training starts with
# have a standard deviation of at most 1 over the photographs.
MAX_CHANGE = 4.0


@dataclass(frozen=True)
class Shown:
    """Constant SH coefficients (N, 3) while a photograph is rendered.

    Attributes:
        own: The coefficients of the scene.
        shown: The coefficients in the photograph.
    """

    own: Tensor
    shown: Tensor


@dataclass
class AppearanceEmbeddings:
    """The embeddings of the training views.

    Attributes:
        embeddings: (V, K).
        adam: (V, K) moments.
    """

    embeddings: Array
    adam: PerCameraAdam = field(init=False)

    def __post_init__(self) -> None:
        views, size = self.embeddings.shape
        self.adam = PerCameraAdam((views, size))

    def show(self, gaussians: Gaussians, index: int) -> Shown:
        """Give the Gaussians the colours of view ``index``, in place, until ``hide``."""
        assert gaussians.appearance is not None
        constant = gaussians.sh[:, 0]
        own = constant.clone()
        constant += colour_offsets(gaussians.appearance, self.embeddings[index])
        return Shown(own, constant.clone())

    def hide(self, gaussians: Gaussians, colours: Shown) -> None:
        """Undo ``show``, but keep what the optimiser has changed since."""
        gaussians.sh[:, 0] = colours.own + (gaussians.sh[:, 0] - colours.shown)

    def step(
        self,
        index: int,
        gaussians: Gaussians,
        d_colors: Tensor,
        moments: Moments,
        rates: AdamRates,
        rate: float,
        backend: Backend,
        threads: int,
    ) -> None:
        """Update the embedding of view ``index``, and ``gaussians.appearance``.

        Args:
            d_colors: (N, 3) gradient of the colours (``Gradients.colors``).
            moments, rates: The state and the rates of Adam for ``gaussians.appearance``.
            rate: The learning rate of the embedding, as a share of ``MAX_CHANGE``.
        """
        assert gaussians.appearance is not None
        d_embedding, d_appearance = appearance_gradients(
            gaussians.appearance, self.embeddings[index], d_colors
        )
        backend.adam_step(gaussians.appearance, d_appearance, moments, rates, threads)
        self.update(index, d_embedding, rate)

    def update(self, index: int, d_embedding: Array, rate: float) -> None:
        """Update the embedding (K,) of view ``index`` by its gradient; ``rate`` as of ``step``."""
        self.embeddings[index] += self.adam.step(index, d_embedding, MAX_CHANGE * rate)

    def centred(
        self, gaussians: Gaussians, names: Sequence[str], gains: Array | None
    ) -> tuple[Gaussians, Appearance]:
        """The same scene with embeddings of mean 0: the Gaussians in the colours of the mean
        photograph, and their appearance in the views with these names and (V, 3) ``gains``."""
        assert gaussians.appearance is not None
        mean = self.embeddings.mean(0)
        appearance = Appearance(
            gaussians.appearance.numpy(),
            dict(zip(names, self.embeddings - mean, strict=True)),
            {} if gains is None else dict(zip(names, gains, strict=True)),
        )
        return replace(with_appearance(gaussians, mean), appearance=None), appearance

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a checkpoint."""
        return {"appearance.embeddings": self.embeddings, **self.adam.arrays("appearance")}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        self.embeddings = arrays["appearance.embeddings"]
        self.adam.restore("appearance", arrays)


def colour_offsets(appearance: Tensor, embedding: Array) -> Tensor:
    """(N, 3) change of SH coefficient 0 in a photograph with this embedding (K,)."""
    offsets = torch.zeros(len(appearance), 3)
    for number, weight in enumerate(embedding.tolist()):
        offsets.add_(appearance[:, number], alpha=weight)
    return offsets


def appearance_gradients(
    appearance: Tensor, embedding: Array, d_colors: Tensor
) -> tuple[Array, Tensor]:
    """Gradients (K,) of an embedding and (N, K, 3) of ``appearance``, from those of the colours
    (N, 3). The colour of a Gaussian is linear in SH coefficient 0, with the factor ``SH_C0``."""
    weights = torch.from_numpy(embedding).float() * SH_C0
    d_appearance = d_colors[:, None] * weights[:, None]
    # Use float64 and numpy, whose sums do not depend on the number of threads.
    d_offsets = d_colors.numpy().astype(np.float64) * SH_C0
    products = (appearance[:, number].numpy() * d_offsets for number in range(len(embedding)))
    return np.array([np.sum(product) for product in products]), d_appearance


def with_appearance(gaussians: Gaussians, embedding: Array, gain: Array | None = None) -> Gaussians:
    """The Gaussians as a photograph with this embedding shows them.

    Args:
        gain: (3,) factors of the colours; None: all 1. A colour is ``0.5 + SH_C0 sh_0 + ...``,
            clamped at 0, so that factors of colours are factors and offsets of the coefficients.
    """
    assert gaussians.appearance is not None
    sh = gaussians.sh.clone()
    sh[:, 0] += colour_offsets(gaussians.appearance, embedding)
    if gain is not None:
        factors = torch.from_numpy(gain).float()
        sh *= factors
        sh[:, 0] += 0.5 / SH_C0 * (factors - 1)
    return replace(gaussians, sh=sh)
