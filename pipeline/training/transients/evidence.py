"""How well the photographs agree with the scene, and with each other on the same surfaces.

The residual r_v(p) of pixel p of view v is the mean absolute difference of render and photograph,
smoothed. Gaussian i has the weight w_iv(p), alpha times transmittance, in that pixel. Over all
views, its mean residual and the number of views that show it are

    m_i = sum_vp w_iv(p) r_v(p) / W_i,    W_i = sum_v w_iv,    n_i = W_i^2 / sum_v w_iv^2,

with w_iv = sum_p w_iv(p). Rendered as colours in view v, they give for each pixel the mean residual
of its surface, m, and the share of the view itself in it, about 1 / n; the residual that the other
views have there is (m - r_v / n) / (1 - 1 / n).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from pipeline.render import Backend, Forward, RasterCamera, RasterOptions
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import SH_C0
from pipeline.training.data.targets import Target

Floats = NDArray[np.float32]

#: Standard deviation of the Gaussian that smooths residuals, pixels of the reduced images.
SMOOTHING = 1.0
#: A surface has other views' evidence if so many views show it.
MIN_VIEWS = 3.0


@dataclass(frozen=True)
class Comparison:
    """A render of a view beside its photograph.

    Attributes:
        residual: (H, W) r_v, 0 at ignored pixels.
        rendered, photo: (H, W) float16 mean of the channels, in [0, 1].
    """

    residual: Floats
    rendered: NDArray[np.float16]
    photo: NDArray[np.float16]


@dataclass(frozen=True)
class ReducedPhotographs:
    """The training views at a reduced size.

    Attributes:
        cameras: The cameras.
        target: The pixels of a view by its index.
        shown: The Gaussians in the colours of a view by its index.
        light_factor: The factor of a view's render by its index (``Inputs.light_factor``).
        options: The options of training.
    """

    cameras: Sequence[RasterCamera]
    target: Callable[[int], Target]
    shown: Callable[[int], Gaussians]
    light_factor: Callable[[int], Tensor | None]
    options: RasterOptions
    backend: Backend

    def render(self, index: int) -> Forward:
        """The render of a view, without its light."""
        parameters = self.shown(index).parameters()
        return self.backend.forward(*parameters, self.cameras[index], self.options)

    def compare(self, index: int, rendered: Forward) -> Comparison:
        """Compare the render of a view with its photograph."""
        target, color = self.target(index), rendered.color
        if (factor := self.light_factor(index)) is not None:
            color = color * factor
        color, image = color.clamp(0.0, 1.0), target.rgb.to(torch.float32) / 255.0
        difference = (color - image).abs().mean(2)
        if target.ignored is not None:
            difference = difference.masked_fill(target.ignored, 0.0)
        return Comparison(
            np.asarray(ndimage.gaussian_filter(difference.numpy(), SMOOTHING)),
            color.mean(2).to(torch.float16).numpy(),
            image.mean(2).to(torch.float16).numpy(),
        )


@dataclass(frozen=True)
class Evidence:
    """What all views say about the Gaussians.

    Attributes:
        views: Each view.
        weight: (N,) W_i, pixels of the reduced images.
        mean: (N,) m_i.
        count: (N,) n_i, at least 1.
    """

    views: Sequence[Comparison]
    weight: Tensor
    mean: Tensor
    count: Tensor


@dataclass(frozen=True)
class Expected:
    """What the surfaces of a view lead to expect.

    Attributes:
        residual: (H, W) mean residual of the surface over the other views.
        support: (H, W) share of the pixel's weight that at least ``MIN_VIEWS`` views show.
    """

    residual: Floats
    support: Floats


def gather(photographs: ReducedPhotographs) -> Evidence:
    """Render every view once, and sum up residuals for each Gaussian."""
    total = squares = weighted = torch.zeros(0)
    views = []
    for index in range(len(photographs.cameras)):
        rendered = photographs.render(index)
        view = photographs.compare(index, rendered)
        images = np.ones_like(view.residual), view.residual
        weight, sums = weights_of(rendered, images, photographs.backend)
        if not len(total):
            total, squares, weighted = (torch.zeros_like(weight) for _ in range(3))
        total += weight
        squares += weight * weight
        weighted += sums
        views.append(view)
    return Evidence(
        views,
        total,
        weighted / total.clamp(min=1e-6),
        (total * total / squares.clamp(min=1e-12)).clamp(min=1.0),
    )


def expected(photographs: ReducedPhotographs, evidence: Evidence, index: int) -> Expected:
    """What the other views lead to expect of view ``index``."""
    colours = torch.stack(
        [evidence.mean, 1 / evidence.count, (evidence.count >= MIN_VIEWS).to(torch.float32)], 1
    )
    options = replace(photographs.options, sh_degree=0, background=None)
    painted = _painted(photographs.shown(index), colours)
    rendered = photographs.backend.forward(
        *painted.parameters(), photographs.cameras[index], options
    )
    mean, own, support = rendered.color.permute(2, 0, 1).numpy()
    alpha = np.maximum(rendered.alpha.numpy(), 1e-3)
    own = np.minimum(own / alpha, 0.5)
    others = (mean / alpha - own * evidence.views[index].residual) / (1 - own)
    return Expected(np.maximum(others, 0.0), support)


def weights_of(
    rendered: Forward, images: tuple[Floats, Floats], backend: Backend
) -> tuple[Tensor, Tensor]:
    """(N,) sums over the pixels of each Gaussian's weight times an image (H, W), for two images:
    the gradients of the sums of two of the colours."""
    first, second = (torch.from_numpy(image) for image in images)
    d_color = torch.stack([first, second, torch.zeros_like(first)], 2)
    colors = backend.backward(rendered, d_color, colors=True).colors
    assert colors is not None
    return colors[:, 0].contiguous(), colors[:, 1].contiguous()


def _painted(gaussians: Gaussians, colours: Tensor) -> Gaussians:
    """The Gaussians in the ``colours`` (N, 3) from all directions."""
    return replace(gaussians.with_sh_degree(0), sh=((colours - 0.5) / SH_C0)[:, None])
