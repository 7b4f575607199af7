"""Values that pass in and out of the rasterizer. Importable without torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class RasterCamera:
    """One pinhole view, COLMAP's convention: x right, y down, z forward.

    Pixel centres lie at half integers: pixel (column i, row j) samples (i + 0.5, j + 0.5).

    Attributes:
        width, height: image size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        world_to_camera: (4, 4) float32 or float64, rigid.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: torch.Tensor


@dataclass(frozen=True)
class RasterOptions:
    """How a view is drawn.

    Attributes:
        sh_degree: active spherical harmonics degree, 0 to 3; coefficients above are ignored.
        background: RGB behind everything; None adds none (the same image as black).
        antialias: scale opacities by Mip-Splatting's compensation, so that the 0.3 px
            dilation changes a Gaussian's size but not its energy.
        near: Gaussians whose centre has camera z <= near are not drawn. In scene units, and
            scenes from photographs have an arbitrary scale: choose it well under the distance
            of the nearest thing worth drawing.
        black_stays: a colour that is clamped at 0 has no gradient (3DGS); otherwise one that would
            raise it passes.
        gradients_per_pixel: a pixel's gradients go only to so many Gaussians, the first that it
            draws (the limit that Kerbl et al. 2023, sec. 7.3, compare with having none); 0: to all.
        threads: 0 for all. The result does not depend on it.
    """

    sh_degree: int = 3
    background: tuple[float, float, float] | None = None
    antialias: bool = False
    near: float = 0.01
    black_stays: bool = False
    gradients_per_pixel: int = 0
    threads: int = 0


@dataclass(frozen=True)
class Forward:
    """A drawn view and what ``backward`` needs of it. Do not write to its tensors.

    Attributes:
        color: (H, W, 3) float32, the background included.
        alpha: (H, W) float32, 1 - transmittance.
        radii: (N,) float32 pixels along the long axis out to where alpha falls to 1/255;
            0: not visible.
        num_visible: Gaussians that touch the image.
        num_dropped: Gaussians left out because a value is not finite or degenerate.
        num_intersections: (Gaussian, tile) pairs, what memory and time go with.
        draw_depths: draws ``depth`` and ``median_depth``.
        state: the backend's own.
    """

    color: torch.Tensor
    alpha: torch.Tensor
    radii: torch.Tensor
    num_visible: int
    num_dropped: int
    num_intersections: int
    draw_depths: Callable[[], tuple[torch.Tensor, torch.Tensor]]
    state: Any

    @cached_property
    def _depths(self) -> tuple[torch.Tensor, torch.Tensor]:
        # At first use: a training step that needs neither does not pay for them.
        return self.draw_depths()

    @property
    def depth(self) -> torch.Tensor:
        """(H, W) float32, sum of weight * camera z, not divided by alpha."""
        return self._depths[0]

    @property
    def median_depth(self) -> torch.Tensor:
        """(H, W) float32, camera z of the Gaussian that takes the transmittance below 0.5; 0 where
        none does."""
        return self._depths[1]


@dataclass(frozen=True)
class CameraGradients:
    """dL/d(change of the camera), float64; ``reference.moved`` says what a change does.

    Attributes:
        rotation: (3,) the scene turned about the camera's centre, radians about its axes.
        translation: (3,) the scene shifted in the camera's frame, world unit.
        focal, principal: (2,) focal lengths and principal point, pixels.
    """

    rotation: torch.Tensor
    translation: torch.Tensor
    focal: torch.Tensor
    principal: torch.Tensor


@dataclass(frozen=True)
class Gradients:
    """dL/d(parameter), float32, each shaped as its parameter; zero for what is not visible.

    Attributes:
        sh: without rows where ``backward`` used it up (``ShAdam``).
        means2d: (N, 2) dL/d(pixel position of the centre).
        means2d_abs: (N, 2) the sum over pixels of the absolute value of each pixel's share of
            means2d (AbsGS, Ye et al. 2024); None when not asked for.
        camera: None when not asked for.
    """

    means: torch.Tensor
    log_scales: torch.Tensor
    quats: torch.Tensor
    opacity_logits: torch.Tensor
    sh: torch.Tensor
    means2d: torch.Tensor
    means2d_abs: torch.Tensor | None
    camera: CameraGradients | None


@dataclass(frozen=True)
class ShAdam:
    """Adam over the spherical harmonics of what the view asks of (``backward``'s ``sh_adam``).

    A Gaussian of which n steps asked nothing, out of view or behind what is opaque, gets in the
    next that does what n steps without a gradient would have done (``reference.sh_adam``): the
    same as dense Adam, but for the colour it is drawn with in that one step.

    Attributes:
        exp_avg, exp_avg_sq: (N, K, 3) float32, moved in place.
        last: (N,) int32, the last step that asked of each Gaussian, 0 before the first; in place.
        rate0, rate: learning rates of the constant coefficient and of the others.
        step: from 1.
    """

    exp_avg: torch.Tensor
    exp_avg_sq: torch.Tensor
    last: torch.Tensor
    rate0: float
    rate: float
    step: int
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15


@dataclass(frozen=True)
class FrameAdam:
    """Adam over means and rotations, in each Gaussian's own frame (``frame_adam``).

    Attributes:
        mean_avg, mean_avg_sq: (N, 3) float32, moments of a mean along the three axes, each in
            units of the scale there; moved in place.
        turn_avg, turn_avg_sq: (N, 3) float32, moments of a turn about the three axes; in place.
        mean_rate: learning rate of the means, in scales.
        turn_rate: of the rotations, in steps of a quaternion of length 1: half the angle.
        step: from 1.
    """

    mean_avg: torch.Tensor
    mean_avg_sq: torch.Tensor
    turn_avg: torch.Tensor
    turn_avg_sq: torch.Tensor
    mean_rate: float
    turn_rate: float
    step: int
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15


@dataclass(frozen=True)
class RenderOutput:
    """A drawn view; color, alpha and depth carry gradients.

    Attributes:
        color: (H, W, 3).
        alpha: (H, W) 1 - transmittance.
        depth: (H, W) sum of weight * camera z, not divided by alpha.
        median_depth: (H, W) camera z of the Gaussian that takes the transmittance below 0.5;
            0 where none does.
        radii: (N,) pixels along the long axis out to where alpha falls to 1/255; 0: not visible.
        num_visible: Gaussians that touch the image.
        num_dropped: Gaussians left out because a value is not finite or degenerate.
    """

    color: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    median_depth: torch.Tensor
    radii: torch.Tensor
    num_visible: int
    num_dropped: int


@dataclass(frozen=True)
class LossResult:
    """loss = (1 - w) error + w (1 - ssim), its parts, and dL/d(rendered) (H, W, 3) float32."""

    loss: float
    error: float
    ssim: float
    grad: torch.Tensor
