"""Inputs and outputs of the rasterizer. Importable without torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor


Color = tuple[float, float, float]
"""RGB in [0, 1]."""

# The projection's Jacobian is evaluated at most this share of tan(fov / 2) outside the image on
# each side (3DGS): further out the linearisation stretches Gaussians too much.
FRUSTUM_MARGIN = 0.3

BACKGROUNDS: dict[str, Color] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@dataclass(frozen=True)
class RasterCamera:
    """A pinhole camera in COLMAP's convention: x right, y down, z forward.

    Pixel centres are at half integers: pixel (column i, row j) samples (i + 0.5, j + 0.5).

    Attributes:
        width, height: The image size in pixels.
        fx, fy, cx, cy: The focal lengths and the principal point in pixels.
        world_to_camera: (4, 4) float32 or float64, rigid.
        part_of: The camera of the whole image if this one shows a part of it, with the same focal
            lengths and pose: a part is rendered as the whole image is.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Tensor
    part_of: RasterCamera | None = None

    @property
    def slopes(self) -> tuple[float, float, float, float]:
        """The smallest and largest x / z, and y / z, at which the projection's Jacobian is
        evaluated: in the whole image, and in a border of ``FRUSTUM_MARGIN``."""
        whole = self.part_of or self
        margin_x = FRUSTUM_MARGIN * 0.5 * whole.width / whole.fx
        margin_y = FRUSTUM_MARGIN * 0.5 * whole.height / whole.fy
        return (
            -whole.cx / whole.fx - margin_x,
            (whole.width - whole.cx) / whole.fx + margin_x,
            -whole.cy / whole.fy - margin_y,
            (whole.height - whole.cy) / whole.fy + margin_y,
        )


@dataclass(frozen=True)
class RasterOptions:
    """Options of rendering.

    Attributes:
        sh_degree: The active degree of the spherical harmonics, 0 to 3. Coefficients above it are
            ignored.
        background: The color behind the Gaussians; None gives the same image as black.
        antialias: Scale opacities by Mip-Splatting's compensation, so that the 0.3 px dilation
            changes a Gaussian's size but not its energy.
        near: The distance of the near plane in world units: Gaussians whose mean has camera z <=
            near are not rendered. Choose it well below the distance of the nearest surface.
        clamp_color_gradient: A colour clamped at 0 has no gradient (3DGS); otherwise gradients that
            would increase it pass.
        threads: The number of threads, 0 for all. The result does not depend on it.
    """

    sh_degree: int = 3
    background: Color | None = None
    antialias: bool = False
    near: float = 0.01
    clamp_color_gradient: bool = False
    threads: int = 0


@dataclass(frozen=True)
class Surroundings:
    """The images of a view around a part of a scene. The image of the whole scene is a composition
    of three layers (Porter and Duff 1984): the front, the part, and the scene behind the part.

    Attributes:
        behind: (H, W, 3) uint8, the scene behind the part over the background.
        alpha: (H, W) uint8, the alpha of the part before training.
        front: (H, W, 3) uint8, the scene in front of the part, multiplied by its alpha; None if
            nothing is in front.
        transmittance: (H, W) uint8, the transmittance of the front; None if nothing is in front.
        correction: (H, W, 3) int8, in 1/255: the difference between the image of the whole scene
            and the composition before training; None if there is none.
    """

    behind: Tensor
    alpha: Tensor
    front: Tensor | None = None
    transmittance: Tensor | None = None
    correction: Tensor | None = None


@dataclass(frozen=True)
class AlphaChangeLoss:
    """``weight`` times the mean square of the part of the change of alpha that exceeds the
    tolerances ``fade`` (of a decrease) and ``growth``."""

    weight: float
    fade: float
    growth: float


@dataclass(frozen=True)
class Subset:
    """Some of N Gaussians, to be rendered without the others.

    Attributes:
        which: (N,) bool, true for these Gaussians.
        background: See ``RasterOptions``.
    """

    which: Tensor
    background: Color | None = None


@dataclass(frozen=True)
class Forward:
    """A rendered view, with the state that ``backward`` needs. Do not write to its tensors.

    Attributes:
        color: (H, W, 3) float32, including the background.
        alpha: (H, W) float32, 1 - transmittance.
        radii: (N,) float32, the semi-major axis of the ellipse {alpha >= 1/255} in pixels; 0 for
            Gaussians that are not visible.
        num_visible: The number of Gaussians that overlap the image.
        num_dropped: The number of Gaussians left out because a value is not finite or degenerate.
        num_intersections: The number of (Gaussian, tile) pairs, to which memory and time are
            proportional.
        render_depths: A function that renders ``depth`` and ``median_depth``.
        state: Private data of the backend.
    """

    color: Tensor
    alpha: Tensor
    radii: Tensor
    num_visible: int
    num_dropped: int
    num_intersections: int
    render_depths: Callable[[], tuple[Tensor, Tensor]]
    state: Any

    @cached_property
    def _depths(self) -> tuple[Tensor, Tensor]:
        # Computed at first use: most training steps need no depths.
        return self.render_depths()

    @property
    def depth(self) -> Tensor:
        """(H, W) float32 sum of weight * camera z, not divided by alpha."""
        return self._depths[0]

    @property
    def median_depth(self) -> Tensor:
        """(H, W) float32 camera z of the Gaussian at which the transmittance falls below 0.5; 0 if
        it does not."""
        return self._depths[1]


@dataclass(frozen=True)
class CameraGradients:
    """dL/d(change of the camera), float64; ``reference.perturbed`` defines a change.

    Attributes:
        rotation: (3,), per radian of a rotation of the scene about the camera's axes.
        translation: (3,), per world unit of a translation of the scene along the camera's axes.
        focal, principal: (2,), per pixel of focal length and principal point.
    """

    rotation: Tensor
    translation: Tensor
    focal: Tensor
    principal: Tensor


@dataclass(frozen=True)
class Gradients:
    """dL/d(parameter), float32, each shaped as its parameter; zero for Gaussians that are not
    visible.

    Attributes:
        sh: The gradient of the SH coefficients; it has no rows if ``backward`` applied it
            (``ShAdam``).
        means2d: (N, 2), the gradient of the projected mean, per pixel.
        colors: (N, 3), the gradient of the colours before they are clamped at 0; None if not
            requested.
        camera: The gradients of the camera; None if not requested.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    opacity_logits: Tensor
    sh: Tensor
    means2d: Tensor
    colors: Tensor | None
    camera: CameraGradients | None


@dataclass(frozen=True)
class AdamRates:
    """The constants of one step of Adam (Kingma and Ba 2015).

    Attributes:
        lr: The learning rate, or the rates: ``Backend.adam_step`` repeats them over the elements,
            for example one for each column; ``Backend.frame_adam`` has two, of the means in units
            of the scales and of the rotations for unit quaternions (half the angle); ``ShAdam`` has
            two, of the constant coefficient and of the others.
        step: The number of the current step, starting at 1.
    """

    lr: float | Sequence[float]
    step: int
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15

    @property
    def rates(self) -> Sequence[float]:
        """The learning rates, of which there is at least one."""
        return (self.lr,) if isinstance(self.lr, int | float) else self.lr


@dataclass(frozen=True)
class Moments:
    """Adam's moments of a tensor: float32, updated in place. ``ShAdam`` has others.

    Attributes:
        exp_avg: The first moment, of the tensor's shape.
        exp_avg_sq: The second moment, of the same shape. For a tensor (N, 3) or (N, 4) it may be
            (N, 1): rows then share the second moment of their mean square, which makes steps
            equivariant under rotation.
    """

    exp_avg: Tensor
    exp_avg_sq: Tensor


@dataclass(frozen=True)
class FrameMoments:
    """The moments of ``Backend.frame_adam``, each (N, 3): of the means along the local axes in
    units of the scales, and of the rotations about the local axes."""

    means: Moments
    rotations: Moments


@dataclass(frozen=True)
class ShAdam:
    """Sparse Adam over the SH coefficients of the Gaussians with a gradient (``Backend.backward``).

    A Gaussian without a gradient in n steps (outside the view or occluded) receives the effect of
    these n steps of dense Adam with zero gradient at its next update (``reference.sh_adam``). The
    result equals dense Adam, except for the colour that is rendered in that step.

    Attributes:
        moments: The first moments of the coefficients, (N, K, 3) bfloat16, rounded to nearest,
            ties to even; and the second moments (N, K, 1) float32, of the mean square of each
            coefficient's channels.
        last: (N,) int32, the last step with a gradient, 0 before the first; updated in place.
        rates: The rates of the constant coefficient and of the others.
    """

    moments: Moments
    last: Tensor
    rates: AdamRates


class ImageGradients(NamedTuple):
    """The gradients of ``Backend.backward`` on the images: (H, W, 3) of the colours, (H, W) of
    alpha and depth; float32."""

    color: Tensor
    alpha: Tensor | None = None
    depth: Tensor | None = None


@dataclass(frozen=True)
class GaussianAdam:
    """Adam over all parameters of Gaussians (``Backend.update``).

    Attributes:
        frames, frame_rates: Those of ``Backend.frame_adam``.
        log_scales, log_scale_rates: Those of ``Backend.adam_step`` for the scales, with one rate.
        opacity_logits, opacity_rates: The same for the opacities.
        sh: Those of the SH coefficients.
    """

    frames: FrameMoments
    frame_rates: AdamRates
    log_scales: Moments
    log_scale_rates: AdamRates
    opacity_logits: Moments
    opacity_rates: AdamRates
    sh: ShAdam


@dataclass(frozen=True)
class ViewGradients:
    """The gradients that ``Backend.update`` leaves to its caller: ``Gradients.colors`` and
    ``Gradients.camera``."""

    colors: Tensor | None
    camera: CameraGradients | None


@dataclass(frozen=True)
class LossResult:
    """loss = (1 - w) error + w (1 - ssim), its parts, the mean squared error (0 if all pixels are
    ignored), and dL/d(rendered) (H, W, 3) float32."""

    loss: float
    error: float
    ssim: float
    squared_error: float
    grad: Tensor
