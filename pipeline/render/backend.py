"""Interface of the rasterizer's backends (``cpu.backend``, ``reference_backend``).

Inputs and outputs are float32 tensors on the CPU; a backend may compute on another device and in
another precision. Results do not depend on the number of threads.

To add a backend, derive a class from ``Backend`` and add it to ``pipeline.render.registry``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Generic, Protocol, TypeVar

from torch import Tensor

from pipeline.render import checks
from pipeline.render.checks import Parameters
from pipeline.render.resident import ResidentTraining
from pipeline.render.types import (
    AdamRates,
    AlphaChangeLoss,
    Forward,
    FrameMoments,
    GaussianAdam,
    Gradients,
    ImageGradients,
    LossResult,
    Moments,
    RasterCamera,
    RasterOptions,
    ShAdam,
    Subset,
    Surroundings,
    ViewGradients,
)


class Projection(Protocol):
    """The part of a result of ``project`` that all backends share."""

    @property
    def radii(self) -> Tensor:
        """See ``Forward.radii``."""


Projected = TypeVar("Projected", bound=Projection)
Binned = TypeVar("Binned")


class Backend(ABC, Generic[Projected, Binned]):
    """The operators, in the order of a training step.

    ``forward`` checks its inputs (see ``checks``); ``project``, ``bin`` and ``blend`` do not check
    again. All other operators check their own inputs.
    """

    @abstractmethod
    def facts(self) -> Mapping[str, str]:
        """Return the facts besides the inputs that determine the rounding of results, by name:
        instruction set, compiler, device. Compiles or loads the backend if necessary."""

    def release_memory(self) -> None:
        """Return to the system the memory that is kept for later calls."""

    def save_memory(self, little: bool) -> None:
        """Choose whether to keep little memory for later calls, which costs some time."""

    def resident(self) -> ResidentTraining | None:
        """Return training in the memory of the backend's device, or None if that is the CPU's."""
        return None

    @abstractmethod
    def project(
        self, parameters: Parameters, camera: RasterCamera, options: RasterOptions
    ) -> Projected:
        """Project Gaussians to 2D Gaussians on the image plane and evaluate their colours."""

    @abstractmethod
    def subset_of(self, projected: Projected, subset: Subset) -> Projected:
        """The projection of a subset of the Gaussians, whose indices stay the same."""

    @abstractmethod
    def bin(self, projected: Projected) -> Binned:
        """List the Gaussians that overlap each tile of the image, front to back.

        Raises:
            UserError: the number of (Gaussian, tile) pairs exceeds the backend's limit.
        """

    @abstractmethod
    def blend(self, binned: Binned) -> Forward:
        """Composite the image from front to back."""

    @abstractmethod
    def backward(
        self,
        fwd: Forward,
        d_color: Tensor,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        *,
        colors: bool = False,
        camera: bool = False,
        sh_adam: ShAdam | None = None,
    ) -> Gradients:
        """Gradients of a scalar with respect to the parameters, from its gradients on the images.

        Args:
            fwd: The result of ``forward``.
            d_color: (H, W, 3) float32.
            d_alpha, d_depth: (H, W) float32 or None.
            colors: Compute ``Gradients.colors``.
            camera: Compute ``Gradients.camera``.
            sh_adam: Update the SH coefficients of the Gaussians with a gradient in place by Adam
                instead of returning their gradients. SH coefficients are four fifths of all
                parameters: this saves the memory traffic of their gradients.
        """

    @abstractmethod
    def l1_ssim(
        self,
        rendered: Tensor,
        target: Tensor,
        ssim_weight: float,
        mask: Tensor | None = None,
        l2_weight: float = 0.0,
        threads: int = 0,
        *,
        factor: Tensor | None = None,
    ) -> LossResult:
        """The loss (1 - w) E + w (1 - SSIM) and its gradient with respect to the rendered image.

        E is the mean of |d| + k d^2 over the differences d; with k = 0 it is the L1 loss of 3DGS.

        Args:
            rendered: (H, W, 3) float32, about [0, 1].
            target: (H, W, 3) float32, or uint8 where 255 represents 1.
            ssim_weight: w in [0, 1].
            mask: (H, W) bool or uint8, non-zero for ignored pixels: the rendered image is replaced
                by the target there, and both means are over the other pixels.
            l2_weight: k >= 0.
            threads: The number of threads, 0 for all.
            factor: (3,) or (H, W, 3) float32, of the rendered image; None: 1.
        """

    @abstractmethod
    def compose(
        self, around: Surroundings, color: Tensor, alpha: Tensor, threads: int = 0
    ) -> Tensor:
        """(H, W, 3) float32 image of a scene, of which one part is rendered:

            C = F + T (C_p + (1 - alpha_p) B) + correction

        with the front's colour F and transmittance T, and what is behind, B.

        Args:
            color: (H, W, 3) float32, C_p without a background.
            alpha: (H, W) float32, alpha_p.
        """

    @abstractmethod
    def compose_backward(
        self,
        around: Surroundings,
        alpha: Tensor,
        d_image: Tensor,
        loss: AlphaChangeLoss,
        threads: int = 0,
    ) -> tuple[Tensor, Tensor]:
        """Gradients with respect to ``color`` (H, W, 3) and ``alpha`` (H, W) of ``compose``, from
        the gradient on its image (H, W, 3) float32, and of the loss on alpha."""

    @abstractmethod
    def adam_step(
        self, param: Tensor, grad: Tensor, moments: Moments, rates: AdamRates, threads: int = 0
    ) -> None:
        """One step of Adam, in place, as ``torch.optim.Adam``.

        Args:
            param, grad: float32, contiguous, of the same shape.
        """

    @abstractmethod
    def frame_adam(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        d_means: Tensor,
        d_quats: Tensor,
        moments: FrameMoments,
        rates: AdamRates,
        threads: int = 0,
    ) -> None:
        """One step of Adam over ``means`` (N, 3) and ``quats`` (N, 4), in place, in the local frame
        of each Gaussian (``reference.frame_adam``). float32, contiguous.

        Steps of a mean are relative to the scale along each axis, so a flat Gaussian moves mostly
        in its plane. Steps are equivariant under rotation and scaling of the world. Quaternions of
        almost zero norm are not updated. Axes and scales are those before the step.
        """

    def observe_gradients(
        self,
        rendered: Forward,
        gradients: Gradients,
        gradient_sum: Tensor,
        seen: Tensor,
        threads: int = 0,
    ) -> None:
        """Add a step to the statistics of density control (``Strategy.statistics``), in place.

        Args:
            gradient_sum: (N,) float32; the norms of the gradients of the projected centres, in
                normalised device coordinates, are added.
            seen: (N,) float32; 1 is added for visible Gaussians.
        """
        height, width = rendered.alpha.shape
        # Pixels to normalised device coordinates: x_ndc = 2 x / width - 1.
        scale = gradients.means2d.new_tensor([0.5 * width, 0.5 * height])
        gradient_sum += (gradients.means2d * scale).double().norm(dim=1).float()
        seen += rendered.radii > 0

    def update(
        self,
        fwd: Forward,
        parameters: Parameters,
        gradients: ImageGradients,
        *,
        adam: GaussianAdam,
        statistics: tuple[Tensor, Tensor] | None = None,
        colors: bool = False,
        camera: bool = False,
    ) -> ViewGradients:
        """``backward``, and then one step of Adam over all parameters, in place. A backend may do
        both at once, without storing gradients.

        Args:
            parameters: Those of ``forward``, contiguous.
            statistics: ``gradient_sum`` and ``seen`` of ``observe_gradients``, to which the step is
                added.
        """
        checks.check_update(parameters, adam, statistics, len(fwd.radii))
        means, log_scales, quats, opacity_logits, _ = parameters
        g = self.backward(fwd, *gradients, colors=colors, camera=camera, sh_adam=adam.sh)
        if statistics is not None:
            self.observe_gradients(fwd, g, *statistics)
        self.frame_adam(means, quats, log_scales, g.means, g.quats, adam.frames, adam.frame_rates)
        self.adam_step(log_scales, g.log_scales, adam.log_scales, adam.log_scale_rates)
        self.adam_step(opacity_logits, g.opacity_logits, adam.opacity_logits, adam.opacity_rates)
        return ViewGradients(g.colors, g.camera)

    def forward(
        self,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        opacity_logits: Tensor,
        sh: Tensor,
        camera: RasterCamera,
        options: RasterOptions,
    ) -> Forward:
        """Render a view, without autograd: project, bin, blend.

        Args:
            means: (N, 3) float32, world coordinates.
            log_scales: (N, 3) float32.
            quats: (N, 4) float32 (wxyz), not necessarily normalised.
            opacity_logits: (N,) float32.
            sh: (N, K, 3) float32, K >= (options.sh_degree + 1)^2.

        Raises:
            ValueError: a tensor has a wrong shape or type, or the camera is invalid.
            UserError: too many (Gaussian, tile) pairs, or the backend cannot be compiled.
        """
        parameters = checks.parameters(
            means, log_scales, quats, opacity_logits, sh, options.sh_degree
        )
        checks.check_camera(camera, options.near)
        return self.blend(self.bin(self.project(parameters, camera, options)))

    def forward_subsets(
        self,
        parameters: Parameters,
        camera: RasterCamera,
        options: RasterOptions,
        subsets: Callable[[Tensor], Iterable[Subset]],
    ) -> Iterator[Forward]:
        """Render subsets of the Gaussians, each without the others; all are projected once. Images
        have the same bits as of these Gaussians alone. Errors: see ``forward``.

        Args:
            subsets: A function from the Gaussians that overlap the image, (N,) bool, to the subsets
                to render.
        """
        parameters = checks.parameters(*parameters, options.sh_degree)
        checks.check_camera(camera, options.near)
        projected = self.project(parameters, camera, options)
        for subset in subsets(projected.radii > 0):
            yield self.blend(self.bin(self.subset_of(projected, subset)))
