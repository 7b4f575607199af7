"""Training steps with all parameters in the memory of a device (``Backend.resident``)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import torch

from pipeline.render.types import (
    AlphaChangeLoss,
    CameraGradients,
    RasterCamera,
    RasterOptions,
    Surroundings,
)


class Planes(Protocol):
    """Images (H, W) float32 of a rendered view, see ``Forward``."""

    @property
    def alpha(self) -> torch.Tensor: ...

    @property
    def depth(self) -> torch.Tensor: ...


HostLosses = Callable[[Planes], tuple[torch.Tensor | None, torch.Tensor | None]]
"""Gradients of losses on alpha and depth (H, W), which are computed on the CPU; None: zero."""


@dataclass(frozen=True)
class Optimised:
    """The tensors that steps change, on the CPU.

    Attributes:
        parameters: means (N, 3), log_scales (N, 3), quats (N, 4), opacity_logits (N,) and sh
            (N, K, 3), by name; and ``appearance`` (N, E, 3) if colours depend on the photograph.
        first, second: Adam's moments by the names of the parameters. With ``GaussianAdam.frames``
            those of quats are (N, 3); without, second moments of means and quats are (N, 1).
        last: (N,) int32, see ``ShAdam``.
        gradient_sum, seen: (N,) float32, sums over the steps of the norm of the 2D mean's gradient
            in normalised device coordinates, and of visibility.
    """

    parameters: Mapping[str, torch.Tensor]
    first: Mapping[str, torch.Tensor]
    second: Mapping[str, torch.Tensor]
    last: torch.Tensor
    gradient_sum: torch.Tensor
    seen: torch.Tensor


@dataclass(frozen=True)
class GaussianAdam:
    """Adam of one step.

    Attributes:
        rates: learning rates of means, log_scales, quats, opacity_logits, sh0 and shN.
        step: number of the step, from 1.
        frames: update means and rotations in the local frames (``FrameAdam``).
        eps: of all parameters, but of the means without ``frames``: ``means_eps``.
    """

    rates: Mapping[str, float]
    step: int
    frames: bool
    beta1: float
    beta2: float
    eps: float
    means_eps: float


@dataclass(frozen=True)
class ResidentImage:
    """A training image.

    Attributes:
        key: images of the same key are the same; None: not to be kept on the device.
        target, mask: as of ``Backend.l1_ssim``.
        gain: factors of the rendered colours.
        surroundings: of a part of a scene, else None.
    """

    key: tuple[int, int] | None
    target: torch.Tensor
    mask: torch.Tensor | None
    gain: tuple[float, float, float]
    surroundings: Surroundings | None


@dataclass(frozen=True)
class ResidentStep:
    """The inputs of a step.

    Attributes:
        ssim_weight, l2_weight: see ``Backend.l1_ssim``.
        camera_gradients: compute them.
        embedding: of the photograph, if there is a parameter ``appearance``: the constant SH
            coefficients are those in the photograph (``training.appearance.embedding``).
        alpha_loss: on alpha, if the image has surroundings.
        losses: other losses, which are computed on the CPU; None: none.
    """

    camera: RasterCamera
    options: RasterOptions
    image: ResidentImage
    ssim_weight: float
    l2_weight: float
    camera_gradients: bool
    embedding: tuple[float, ...] | None
    alpha_loss: AlphaChangeLoss
    losses: HostLosses | None
    adam: GaussianAdam


@dataclass(frozen=True)
class StepResult:
    """Of one step: ``loss`` as ``LossResult.loss``; ``squared_error``, the mean squared difference
    of the unmasked values; ``embedding``, the gradient of the embedding; the others as of
    ``Forward`` and ``Gradients``."""

    loss: float
    squared_error: float
    num_visible: int
    num_dropped: int
    camera: CameraGradients | None
    embedding: tuple[float, ...] | None


@dataclass(frozen=True)
class TrainingSize:
    """What the memory of a training depends on.

    Attributes:
        gaussians: at most.
        sh_coefficients: of each Gaussian, at the end.
        pixels: of the largest view.
        image_bytes: of all training images.
    """

    gaussians: int
    sh_coefficients: int
    pixels: int
    image_bytes: int


class ResidentTraining(ABC):
    """Gaussians in a device's memory, with Adam's moments and the statistics of density control."""

    @abstractmethod
    def memory_line(self, size: TrainingSize) -> str:
        """A line for the log with the memory that a training takes.

        Raises:
            UserError: more than the device has, as far as it is known.
        """

    @abstractmethod
    def load(self, optimised: Optimised) -> None:
        """Copy the tensors to the device."""

    @abstractmethod
    def step(self, step: ResidentStep) -> StepResult:
        """Render, compare, differentiate and update, as ``forward``, ``l1_ssim``, ``backward`` and
        the optimiser's operators do."""

    @abstractmethod
    def store(self, optimised: Optimised) -> None:
        """Copy the tensors back, in place. The copies on the device stay valid."""
