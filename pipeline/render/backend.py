"""What a backend of the rasterizer does; ``cpu`` and ``reference_backend`` are two of them.

Training, evaluation and all else call these operators and know nothing of how they are computed.
Tensors are float32 on the CPU as they come in and go out; a backend may compute elsewhere and in
another precision. The same inputs give the same bits at any number of threads.

A further backend is a class that derives from ``Backend``, and a line in ``make_backend``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Generic, TypeVar

import torch

from pipeline.render import checks
from pipeline.render.checks import Parameters
from pipeline.render.types import (
    Forward,
    FrameAdam,
    Gradients,
    LossResult,
    RasterCamera,
    RasterOptions,
    ShAdam,
)

Projected = TypeVar("Projected")
Binned = TypeVar("Binned")

BACKENDS = ("cpu", "reference")


class Backend(ABC, Generic[Projected, Binned]):
    """The operators, in the order of a training step. Implementations may trust what they get to
    be checked (``checks``), except where they are called one by one."""

    @abstractmethod
    def facts(self) -> Mapping[str, str]:
        """What decides the last bits beside the inputs, by name: an instruction set, a compiler, a
        device. Compiles or loads what is missing."""

    @abstractmethod
    def project(
        self, parameters: Parameters, camera: RasterCamera, options: RasterOptions
    ) -> Projected:
        """Gaussians to ellipses on the image, with their colours."""

    @abstractmethod
    def bin(self, projected: Projected) -> Binned:
        """Which ellipses each part of the image is covered by, front to back.

        Raises:
            UserError: more of them than memory is meant for.
        """

    @abstractmethod
    def blend(self, binned: Binned) -> Forward:
        """The image."""

    @abstractmethod
    def backward(
        self,
        fwd: Forward,
        d_color: torch.Tensor,
        d_alpha: torch.Tensor | None = None,
        d_depth: torch.Tensor | None = None,
        *,
        means2d_abs: bool = True,
        camera: bool = False,
        sh_adam: ShAdam | None = None,
    ) -> Gradients:
        """The gradients of a scalar, given its gradients on the images.

        Args:
            d_color: (H, W, 3) float32; d_alpha, d_depth: (H, W) float32 or None.
            means2d_abs: sum absolute values too; about a fifth of the time.
            camera: give the camera's gradients, too.
            sh_adam: move the harmonics of the Gaussians in view by Adam at once, in place, instead
                of giving their gradients: those are four fifths of all, and would only be written
                to be read again.
        """

    @abstractmethod
    def l1_ssim(
        self,
        rendered: torch.Tensor,
        target: torch.Tensor,
        ssim_weight: float,
        mask: torch.Tensor | None = None,
        square_weight: float = 0.0,
        threads: int = 0,
    ) -> LossResult:
        """The loss (1 - w) E + w (1 - SSIM), and its gradient on the render. E is the mean of
        |d| + k d^2 over the differences d: with k = 0, 3DGS's L1.

        Args:
            rendered: (H, W, 3) float32 in [0, 1] or thereabouts.
            target: (H, W, 3) float32, or uint8 of which 255 is 1.
            ssim_weight: w in [0, 1].
            mask: (H, W) bool or uint8, not zero where a pixel is left out: the render is replaced
                by the target there, and both means are over the other pixels.
            square_weight: k >= 0.
        """

    @abstractmethod
    def adam_step(
        self,
        param: torch.Tensor,
        grad: torch.Tensor,
        exp_avg: torch.Tensor,
        exp_avg_sq: torch.Tensor,
        lr: float | Sequence[float],
        step: int,
        beta1: float = 0.9,
        beta2: float = 0.999,
        eps: float = 1e-15,
        threads: int = 0,
    ) -> None:
        """One step of Adam in place, as torch.optim.Adam takes it; ``step`` counts from 1.

        All four tensors: float32, contiguous, of one shape. ``lr`` may be several rates, which
        repeat over the elements: one for each element of a row, say.

        Rows of 3 or 4 may share a second moment, that of their mean square: ``exp_avg_sq`` is
        (N, 1) then, and ``lr`` one rate. Where the rows' space is turned, the steps turn with it.
        """

    @abstractmethod
    def frame_adam(
        self,
        means: torch.Tensor,
        quats: torch.Tensor,
        log_scales: torch.Tensor,
        d_means: torch.Tensor,
        d_quats: torch.Tensor,
        adam: FrameAdam,
        threads: int = 0,
    ) -> None:
        """One step of Adam over ``means`` (N, 3) and ``quats`` (N, 4) in place, along and about
        each Gaussian's own axes (``reference.frame_adam``). float32, contiguous.

        A mean goes as many of the scales along each axis as Adam says, so a flat Gaussian slides in
        its plane, and hardly leaves it; where the world is turned or grows, the steps turn and grow
        with it. A quaternion of no direction is not turned. Axes and scales are those before the
        step.
        """

    def forward(
        self,
        means: torch.Tensor,
        log_scales: torch.Tensor,
        quats: torch.Tensor,
        opacity_logits: torch.Tensor,
        sh: torch.Tensor,
        camera: RasterCamera,
        options: RasterOptions,
    ) -> Forward:
        """Draw a view, without autograd: project, bin, blend.

        Args:
            means: (N, 3) float32, world.
            log_scales: (N, 3) float32.
            quats: (N, 4) float32 wxyz, of any length.
            opacity_logits: (N,) float32.
            sh: (N, K, 3) float32, K >= (options.sh_degree + 1)^2.

        Raises:
            ValueError: shapes or types that do not fit, a camera that is none.
            UserError: more Gaussians in a view than memory is meant for; no compiler.
        """
        parameters = checks.parameters(
            means, log_scales, quats, opacity_logits, sh, options.sh_degree
        )
        checks.check_camera(camera, options.near)
        return self.blend(self.bin(self.project(parameters, camera, options)))


@cache
def make_backend(name: str = "cpu") -> Backend:
    """The backend of this name, one of ``BACKENDS``."""
    # Imports that are written out: stages' keys hash the code that they lead to.
    if name == "cpu":
        from pipeline.render.cpu.backend import CpuBackend

        return CpuBackend()
    if name == "reference":
        from pipeline.render.reference_backend import ReferenceBackend

        return ReferenceBackend()
    raise ValueError(f"no backend {name!r}; there are {', '.join(BACKENDS)}")
