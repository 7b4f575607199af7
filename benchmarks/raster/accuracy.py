"""Errors of the kernels against the float64 reference, in a window at the image centre."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import torch

from benchmarks.raster.measure import BACKGROUND, Step
from benchmarks.raster.scenes import synthetic
from pipeline.render import RasterOptions, make_backend, reference

WINDOW = 32  # pixels
NAMES = ("means", "log_scales", "quats", "opacity_logits", "sh")


@dataclass(frozen=True)
class Accuracy:
    """The errors against the reference.

    Attributes:
        colour: The largest error of pixels that are not near a cut-off.
        gradient: The largest relative L2 error of the gradients of the five parameters.
    """

    colour: float
    gradient: float


def accuracy(step: Step) -> Accuracy:
    """The errors in the window, for the gradient of a random linear function of its colours.

    Gaussians outside the window are excluded from the reference, to limit its memory.
    """
    scene, camera = step.scene, step.scene.camera
    w, h = min(WINDOW, camera.width), min(WINDOW, camera.height)
    left, top = (camera.width - w) // 2, (camera.height - h) // 2
    options = RasterOptions(background=BACKGROUND)
    centres = step.state.projected.records[:, :4].view(torch.float64)
    middle = torch.tensor([left + w / 2, top + h / 2])
    extent = torch.tensor([w / 2, h / 2])
    near = ((centres - middle).abs() < extent + step.drawn.radii[:, None] + 1).all(1)
    rows = torch.nonzero(near & (step.drawn.radii > 0)).squeeze(1)

    inputs = [g[rows].double().requires_grad_() for g in scene.gaussians]
    means, log_scales, quats, logits, sh = inputs
    projection = reference.project(means, log_scales, quats, logits, sh, camera, options)
    colors = reference.sh_colors(means[projection.index], sh[projection.index], camera, 3)
    moved = replace(projection, means2d=projection.means2d - torch.tensor([left, top]))
    image = reference.blend(moved, colors, replace(camera, width=w, height=h), options)
    window = (slice(top, top + h), slice(left, left + w))
    certain = image.margin > 1e-5
    error = (step.drawn.color[window] - image.color.detach()).abs().amax(-1)[certain]
    d_window = torch.randn(h, w, 3, generator=torch.Generator().manual_seed(2)) * certain[..., None]
    d_color = torch.zeros(camera.height, camera.width, 3)
    d_color[window] = d_window
    gradients = make_backend("cpu").backward(step.drawn, d_color)
    expected = torch.autograd.grad((image.color * d_window).sum(), inputs)
    relative = [
        float((getattr(gradients, name)[rows] - value).norm() / value.norm().clamp(min=1e-30))
        for name, value in zip(NAMES, expected, strict=True)
    ]
    return Accuracy(float(error.max()), max(relative))


@dataclass(frozen=True)
class ReferenceRatio:
    """The milliseconds of forward and backward on a scene small enough for the reference."""

    scene: str
    reference: float
    kernels: float


def reference_ratio(threads: int) -> ReferenceRatio:
    backend, scene = make_backend("cpu"), synthetic(1000, 96, 54, 5.0)
    options = RasterOptions(background=BACKGROUND, threads=threads)
    weight = torch.rand(54, 96, 3, generator=torch.Generator().manual_seed(3))

    def in_torch() -> None:
        means, scales, quats, logits, sh = (g.clone().requires_grad_() for g in scene.gaussians)
        _, image = reference.render(means, scales, quats, logits, sh, scene.camera, options)
        (image.color * weight).sum().backward()

    def in_kernels() -> None:
        backend.backward(backend.forward(*scene.gaussians, scene.camera, options), weight)

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    best = []
    for run, repeats in ((in_torch, 1), (in_kernels, 9)):
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            run()
            times.append(1e3 * (time.perf_counter() - start))
        best.append(min(times))
    torch.set_num_threads(before)
    return ReferenceRatio(scene.name, *best)
