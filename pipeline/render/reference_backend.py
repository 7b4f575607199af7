"""The float64 reference implementation as a backend, to which others are compared. For small
scenes only."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor

from pipeline.render import checks, reference, reference_adam
from pipeline.render.backend import Backend
from pipeline.render.checks import Parameters
from pipeline.render.types import (
    AdamRates,
    AlphaChangeLoss,
    CameraGradients,
    Forward,
    FrameMoments,
    Gradients,
    LossResult,
    Moments,
    RasterCamera,
    RasterOptions,
    ShAdam,
    Subset,
    Surroundings,
)
from pipeline.splats.init import SH_C0


@dataclass(frozen=True)
class Projected:
    """The visible Gaussians on the image plane, with an autograd graph in float64.

    Attributes:
        parameters: The input parameters.
        leaves: Their float64 copies, which require gradients.
        change: (10,) zeros that require gradients.
        camera: ``reference.perturbed`` of the input camera and ``change``.
    """

    parameters: Parameters
    leaves: Parameters
    change: Tensor
    camera: RasterCamera
    options: RasterOptions
    projection: reference.Projection

    @property
    def radii(self) -> Tensor:
        return self.projection.radii.float()


@dataclass(frozen=True)
class State:
    """State of a rendered view for ``backward``."""

    projected: Projected
    image: reference.Blend


class ReferenceBackend(Backend[Projected, Projected]):
    """The functions of ``reference``, differentiated by autograd. Memory is proportional to pixels
    times Gaussians."""

    def facts(self) -> Mapping[str, str]:
        return {"instruction_set": "float64 reference", "compiler": f"torch {torch.__version__}"}

    def project(
        self, parameters: Parameters, camera: RasterCamera, options: RasterOptions
    ) -> Projected:
        leaves = cast(Parameters, tuple(t.double().requires_grad_() for t in parameters))
        change = torch.zeros(10, dtype=torch.float64, requires_grad=True)
        perturbed = reference.perturbed(camera, change)
        projection = reference.project(*leaves, perturbed, options)
        return Projected(parameters, leaves, change, perturbed, options, projection)

    def subset_of(self, projected: Projected, subset: Subset) -> Projected:
        whole = vars(projected.projection)
        rows = subset.which[whole["index"]]
        of_visible = ("index", "means2d", "conics", "depths", "opacities")
        projection = reference.Projection(
            **{name: whole[name][rows] for name in of_visible},
            radii=torch.where(subset.which, whole["radii"], 0.0),
            num_dropped=whole["num_dropped"],
        )
        options = replace(projected.options, background=subset.background)
        return replace(projected, projection=projection, options=options)

    def bin(self, projected: Projected) -> Projected:
        return projected

    def blend(self, binned: Projected) -> Forward:
        means, _, _, _, sh = binned.leaves
        projection = binned.projection
        image = reference.draw(means, sh, projection, binned.camera, binned.options)
        return Forward(
            image.color.detach().float(), image.alpha.detach().float(), binned.radii,
            len(projection.index), projection.num_dropped, image.pairs,
            lambda: (image.depth.detach().float(), image.median_depth.float()),
            State(binned, image),
        )  # fmt: skip

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
        state: State = fwd.state
        projected, image = state.projected, state.image
        size = projected.camera.width, projected.camera.height
        d_color, d_alpha, d_depth = checks.image_gradients(d_color, d_alpha, d_depth, size)
        total = (image.color * d_color).sum()
        for plane, gradient in ((image.alpha, d_alpha), (image.depth, d_depth)):
            if gradient is not None:
                total = total + (plane * gradient).sum()
        found = torch.autograd.grad(
            total,
            [*projected.leaves, projected.change, projected.projection.means2d],
            retain_graph=True,
            allow_unused=True,
            materialize_grads=True,
        )
        arrays, d_change, d_centres = found[:5], found[5], found[6]
        count = len(arrays[0])
        d_means2d = torch.zeros(count, 2)
        d_means2d[projected.projection.index] = d_centres.float()
        d_sh = arrays[4]
        # The constant basis function is the same for every direction.
        d_colors = (d_sh[:, 0] / SH_C0).float() if colors else None
        if sh_adam is not None:
            updated = torch.cat([g.reshape(count, -1) for g in arrays], 1).any(1)
            _step_sh(projected.parameters[4], d_sh, updated, sh_adam)
            d_sh = d_sh[:0]
        return Gradients(
            arrays[0].float(), arrays[1].float(), arrays[2].float(), arrays[3].float(),
            d_sh.float(), d_means2d, d_colors,
            CameraGradients(*d_change.split([3, 3, 2, 2])) if camera else None,
        )  # fmt: skip

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
        rendered, target, mask, factor = checks.images(rendered, target, mask, factor)
        leaf = rendered.double().requires_grad_()
        lit = leaf if factor is None else leaf * factor.double()
        ignored = None if mask is None else mask.bool()
        loss, error, ssim = reference.l1_ssim(lit, target, ssim_weight, ignored, l2_weight)
        (grad,) = torch.autograd.grad(loss, leaf)
        squared = reference.mean_squared_error(lit, target, ignored)
        return LossResult(
            loss=float(loss.detach()),
            error=float(error.detach()),
            ssim=float(ssim.detach()),
            squared_error=float(squared.detach()),
            grad=grad.float(),
        )

    def compose(
        self, around: Surroundings, color: Tensor, alpha: Tensor, threads: int = 0
    ) -> Tensor:
        color, alpha = checks.layers(around, color, alpha)
        return reference.compose(around, color.double(), alpha.double()).float()

    def compose_backward(
        self,
        around: Surroundings,
        alpha: Tensor,
        d_image: Tensor,
        loss: AlphaChangeLoss,
        threads: int = 0,
    ) -> tuple[Tensor, Tensor]:
        d_image, alpha = checks.layers(around, d_image, alpha)
        # The composition is linear in the colour.
        color = torch.zeros(d_image.shape, dtype=torch.float64, requires_grad=True)
        change = alpha.double().requires_grad_()
        total = (reference.compose(around, color, change) * d_image).sum()
        (total + reference.alpha_change_loss(around, change, loss)).backward()
        assert color.grad is not None and change.grad is not None
        return color.grad.float(), change.grad.float()

    def adam_step(
        self, param: Tensor, grad: Tensor, moments: Moments, rates: AdamRates, threads: int = 0
    ) -> None:
        checks.check_adam(param, grad, moments, rates)
        with _in_double(param, *vars(moments).values()) as (p, *doubles):
            reference_adam.adam_step(p, grad.double(), Moments(*doubles), rates)

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
        parameters, gradients = (means, quats, log_scales), (d_means, d_quats)
        checks.check_frame_adam(parameters, gradients, moments, rates)
        tensors = *vars(moments.means).values(), *vars(moments.rotations).values()
        with _in_double(means, quats, *tensors) as (m, q, *doubles):
            precise = FrameMoments(Moments(*doubles[:2]), Moments(*doubles[2:]))
            d_m, d_q = d_means.double(), d_quats.double()
            reference_adam.frame_adam(m, q, log_scales.double(), d_m, d_q, precise, rates)


def _step_sh(sh: Tensor, grad: Tensor, updated: Tensor, adam: ShAdam) -> None:
    checks.check_sh_adam(adam, sh)
    with _in_double(sh, adam.moments.exp_avg_sq) as (p, v):
        moments = replace(adam.moments, exp_avg_sq=v)
        reference_adam.sh_adam(p, grad, updated, replace(adam, moments=moments))


@contextmanager
def _in_double(*tensors: Tensor) -> Iterator[list[Tensor]]:
    """Float64 copies of tensors, whose values are copied back at the end."""
    with torch.no_grad():
        doubles = [tensor.double() for tensor in tensors]
        yield doubles
        for tensor, double in zip(tensors, doubles, strict=True):
            tensor.copy_(double)
