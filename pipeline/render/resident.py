"""Training steps with all parameters in the memory of a device (``Backend.resident``)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from torch import Tensor

from pipeline.render.checks import Parameters
from pipeline.render.types import (
    AdamRates,
    AlphaChangeLoss,
    CameraGradients,
    RasterCamera,
    RasterOptions,
    Surroundings,
)


class Planes(Protocol):
    """Images (H, W) float32 of a rendered view, see ``Forward``."""

    @property
    def alpha(self) -> Tensor: ...

    @property
    def depth(self) -> Tensor: ...


HostLosses = Callable[[Planes], tuple[Tensor | None, Tensor | None]]
"""Gradients of losses on alpha and depth (H, W), which are computed on the CPU; None: zero."""


@dataclass(frozen=True)
class Optimised:
    """The tensors that steps change, on the CPU.

    Attributes:
        parameters: means (N, 3), log_scales (N, 3), quats (N, 4), opacity_logits (N,) and sh
            (N, K, 3), by name; and ``appearance`` (N, E, 3) if colours depend on the photograph.
        first, second: Adam's moments by the names of the parameters. ``ShAdam`` has those of sh.
            If means and rotations are updated in the local frames, the moments of quats are
            (N, 3); otherwise the second moments of means and quats are (N, 1).
        last: (N,) int32, see ``ShAdam``.
        gradient_sum, seen: (N,) float32, the sums over the steps of the norm of the 2D mean's
            gradient in normalised device coordinates, and of visibility.
    """

    parameters: Mapping[str, Tensor]
    first: Mapping[str, Tensor]
    second: Mapping[str, Tensor]
    last: Tensor
    gradient_sum: Tensor
    seen: Tensor


class Part(IntEnum):
    """A part of ``Optimised``, which contains the parts before.

    Attributes:
        GEOMETRY: All parameters but the colours, and the statistics of density control.
        PARAMETERS: The colours, and ``last``.
        ALL: Adam's moments.
    """

    NOTHING = 0
    GEOMETRY = 1
    PARAMETERS = 2
    ALL = 3


@dataclass(frozen=True)
class ResidentImage:
    """A training image.

    Attributes:
        key: Images of the same key are the same; an image without a key is not kept on the device.
        target, mask: As of ``Backend.l1_ssim``.
        gain: Factors of the rendered colours.
        surroundings: The surroundings of a part of a scene, or None.
    """

    key: tuple[int, ...] | None
    target: Tensor
    mask: Tensor | None
    gain: tuple[float, float, float]
    surroundings: Surroundings | None


@dataclass(frozen=True)
class ResidentStep:
    """The inputs of a step.

    Attributes:
        ssim_weight, l2_weight: See ``Backend.l1_ssim``.
        camera_gradients: Whether to compute the gradients of the camera.
        embedding: The photograph's embedding, if there is a parameter ``appearance``: the constant
            SH coefficients are those in the photograph (``training.appearance.embedding``).
        alpha_loss: The loss on alpha, which applies if the image has surroundings.
        losses: Other losses, which are computed on the CPU, or None.
        adam: The rates of each parameter by its name. ``frames`` has those of means and rotations
            in the local frames (``Backend.frame_adam``), instead of ``means`` and ``quats``.
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
    adam: Mapping[str, AdamRates]


@dataclass(frozen=True)
class StepResult:
    """The result of one step: ``loss`` as in ``LossResult``, ``squared_error``, the mean squared
    difference of the unmasked values, and ``embedding``, the gradient of the embedding. ``Forward``
    and ``Gradients`` document the other fields."""

    loss: float
    squared_error: float
    num_visible: int
    num_dropped: int
    camera: CameraGradients | None
    embedding: tuple[float, ...] | None


@dataclass(frozen=True)
class TrainingSize:
    """The numbers on which the memory of a training depends.

    Attributes:
        gaussians: The maximum number of Gaussians.
        sh_coefficients: The SH coefficients of each Gaussian at the end.
        pixels: The pixels of the largest view.
        image_bytes: The bytes of all training images.
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
            UserError: It is more than the device is known to have.
        """

    @abstractmethod
    def load(self, optimised: Optimised, part: Part = Part.ALL) -> None:
        """Copy a part of the tensors to the device."""

    @abstractmethod
    def load_moments(self, optimised: Optimised, name: str) -> None:
        """Copy the moments of one of the parameters of the geometry to the device."""

    @abstractmethod
    def select(self, rows: Tensor, blank: Tensor, row: Optimised) -> None:
        """Replace colours, moments and ``last`` by copies of their rows, in the device's memory.
        If the number of Gaussians changes, ``Part.GEOMETRY`` has to be loaded afterwards.

        Args:
            rows: (M,) int64, the row that each Gaussian is copied from.
            blank: (M,) bool, the Gaussians that get the moments of ``row`` instead.
            row: One Gaussian. Rows have its shapes: they get zeros at the end if they were
                shorter.
        """

    @abstractmethod
    def lend(self, parameters: Parameters) -> None:
        """Let the backend's operators render the device's Gaussians for these tensors, whose values
        need not be current, until the next step or change."""

    @abstractmethod
    def bad_colors(self) -> Tensor:
        """(N,) bool, the Gaussians with colours that are not finite; waits for the steps."""

    @abstractmethod
    def step(self, step: ResidentStep) -> None:
        """Render, compare, differentiate and update, as ``forward``, ``l1_ssim``, ``backward`` and
        the optimiser's operators do. The device may do so later, but in order.

        ``step.losses`` may be called more than once, and until the step's result is read.
        """

    @abstractmethod
    def results(self) -> list[StepResult]:
        """The results of the steps since the last call, in order; waits for them.

        Raises:
            UserError: The memory of the device does not suffice, or the device is lost.
        """

    @abstractmethod
    def store(self, optimised: Optimised, part: Part = Part.ALL) -> None:
        """Copy a part of the tensors back, in place. The copies on the device stay valid."""
