"""The C++ kernels compared with the float64 reference, and properties of their results."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from pipeline.render import (
    AdamRates,
    Backend,
    FrameMoments,
    Gradients,
    Moments,
    RasterCamera,
    RasterOptions,
    reference,
)
from pipeline.render.gpu.backend import GpuBackend
from tests.render.scenes import IMAGES, NAMES, Case, Scene, camera, random_scene, relative

CASES = [
    Case(0, 300, (64, 48), RasterOptions()),
    Case(1, 700, (97, 53), RasterOptions(background=(0.2, 0.5, 0.9))),
    Case(2, 500, (71, 50), RasterOptions(antialias=True, sh_degree=1)),
    Case(3, 200, (33, 17), RasterOptions(sh_degree=0, background=(1.0, 1.0, 1.0))),
    Case(4, 300, (16, 80), RasterOptions(sh_degree=2, antialias=True, background=(0.0, 0.3, 0.0))),
    Case(7, 900, (45, 38), RasterOptions(background=(0.9, 0.1, 0.4))),
    Case(5, 60, (1, 1), RasterOptions()),
    Case(6, 250, (130, 3), RasterOptions(near=3.5)),
]


def reference_image(scene: Scene, cam: RasterCamera, options: RasterOptions):
    inputs = [t.double().requires_grad_() for t in scene]
    return inputs, *reference.render(*inputs, cam, options)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.seed)
def test_kernels_equal_the_reference(any_backend: Backend, case: Case) -> None:
    """Colours to 2e-6 (4e-6 on a GPU, which projects in float32), gradients to 1e-5, except for
    pixels close to a threshold of the method."""
    fwd = any_backend.forward(*case.scene, case.camera, case.options)
    projection, _ = case.rendered
    assert fwd.num_visible == len(projection.index) > 0
    assert fwd.num_dropped == projection.num_dropped == 0
    images = {name: getattr(fwd, name) for name in (*IMAGES, "radii")}
    case.check_images(images, 4e-6 if isinstance(any_backend, GpuBackend) else 2e-6)
    d_color, d_alpha, _ = case.incoming
    for incoming in ([d_color, None, None], [d_color, d_alpha, None], case.incoming):
        found = dict(vars(any_backend.backward(fwd, *incoming, colors=True)))
        case.check_gradients(
            {name: found[name] for name in (*NAMES, "means2d", "colors")}, incoming
        )


@pytest.mark.parametrize("case", CASES[:6], ids=lambda case: case.seed)
def test_camera_gradients_equal_the_reference(backend: Backend, case: Case) -> None:
    """Sums over all Gaussians, in spite of cancellation, to a relative error of 1e-5."""
    case = replace(case, gaussian_size=0.15)
    d_color, d_depth, _ = case.incoming
    found = []
    for threads in (1, 3):
        fwd = backend.forward(*case.scene, case.camera, replace(case.options, threads=threads))
        gradients = backend.backward(fwd, d_color, d_depth=d_depth, colors=True, camera=True)
        assert gradients.camera is not None
        found.append(vars(gradients) | {"camera": torch.cat([*vars(gradients.camera).values()])})
    assert torch.equal(found[0]["camera"], found[1]["camera"])
    case.check_gradients(found[0], [d_color, None, d_depth])
    assert backend.backward(fwd, d_color).camera is None


@pytest.mark.parametrize("seed", range(6))
def test_culling_of_groups_of_sixteen(backend: Backend, seed: int) -> None:
    """Clusters of 16 Gaussians of all sizes around the camera, some of which just reach into the
    image: the culling of groups agrees with the reference."""
    gen = torch.Generator().manual_seed(seed)
    clusters = 400
    scene = random_scene(seed, 16 * clusters)
    centre = 6 * torch.randn(clusters, 3, generator=gen)
    size = 10 ** (3 * torch.rand(clusters, generator=gen) - 2.5)

    def each(values: torch.Tensor) -> torch.Tensor:
        return values.repeat_interleave(16, 0)

    shift = torch.randn(16 * clusters, 3, generator=gen) * each(size)[:, None]
    scene[0][:] = each(centre) + 0.3 * shift
    scene[1][:] += each(size).log()[:, None] - math.log(0.07)
    scene[2][:: 16 * 37] = 0.0  # invalid rotations are dropped and counted anywhere
    cam, options = camera(40, 30, rotated=seed % 2 == 1), RasterOptions()
    fwd = backend.forward(*scene, cam, options)
    expected = reference.project(*(t.double() for t in scene), cam, options)
    seen = torch.nonzero(fwd.radii)[:, 0]
    assert torch.equal(seen, expected.index)
    assert fwd.num_dropped == expected.num_dropped >= 10
    whole = (fwd.radii.view(clusters, 16) > 0).sum(1)
    assert (whole == 0).sum() > 100 and ((whole > 0) & (whole < 16)).sum() > 20


def single(mean: tuple[float, float, float], sigma: float, opacity: float = 0.9) -> Scene:
    logit = math.log(opacity / (1 - opacity))
    sh = torch.full((1, 1, 3), 1.0)
    return (
        torch.tensor([mean]), torch.full((1, 3), math.log(sigma)),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([logit]), sh,
    )  # fmt: skip


def test_pixel_centres_are_at_half_integers(backend: Backend) -> None:
    """A Gaussian projected to (20.5, 10.5) peaks in column 20, row 10, and is symmetric."""
    cam = RasterCamera(41, 33, 50.0, 50.0, 20.5, 10.5, torch.eye(4))
    scene = single((0.0, 0.0, 2.0), 0.08)
    alpha = backend.forward(*scene, cam, RasterOptions(sh_degree=0)).alpha
    assert divmod(int(alpha.argmax()), 41) == (10, 20)
    assert abs(float(alpha[10, 20]) - 0.9) < 1e-6
    around = torch.stack([alpha[9, 20], alpha[11, 20], alpha[10, 19], alpha[10, 21]])
    assert (around - around[0]).abs().max() < 1e-6 and around[0] < 0.9


def test_equal_depths_are_composited_in_order_of_index(backend: Backend) -> None:
    first, second = single((0.0, 0.0, 2.0), 0.2), single((0.0, 0.0, 2.0), 0.2)
    second[4].mul_(-1)  # dark
    cam, options = camera(16, 16), RasterOptions(sh_degree=0)
    bright = backend.forward(*(torch.cat(p) for p in zip(first, second, strict=True)), cam, options)
    dark = backend.forward(*(torch.cat(p) for p in zip(second, first, strict=True)), cam, options)
    assert bright.color.max() > 2 * dark.color.max()


def test_results_are_bit_identical_for_any_number_of_threads(backend: Backend) -> None:
    for seed in range(100):
        # Some scenes are large enough for three threads.
        count, height = (1500, 110) if seed % 10 == 0 else (20 + 3 * seed, 40)
        scene, cam = random_scene(seed, count), camera(30 + 7 * (seed % 29), height)
        d_color = torch.randn(height, cam.width, 3, generator=torch.Generator().manual_seed(seed))
        runs = []
        for threads in (1, 2, 3):
            fwd = backend.forward(*scene, cam, RasterOptions(threads=threads))
            g = backend.backward(fwd, d_color)
            loss = backend.l1_ssim(fwd.color, d_color.abs(), 0.2, threads=threads)
            param, m, v = scene[4].clone(), torch.zeros_like(scene[4]), torch.ones_like(scene[4])
            rates = AdamRates(1e-2, 3)
            backend.adam_step(param, g.sh, Moments(m, v), rates, threads)
            means, quats, frames = scene[0].clone(), scene[2].clone(), torch.ones(4, *g.means.shape)
            moments = FrameMoments(Moments(*frames[:2]), Moments(*frames[2:]))
            rates = AdamRates((1e-2, 1e-3), 3)
            backend.frame_adam(means, quats, scene[1], g.means, g.quats, moments, rates, threads)
            runs.append([
                fwd.color, fwd.alpha, fwd.depth, fwd.median_depth, fwd.radii, g.means,
                g.log_scales, g.quats, g.opacity_logits, g.sh, g.means2d,
                loss.grad, torch.tensor([loss.loss, loss.error, loss.ssim]), param, m, v,
                means, quats, frames,
            ])  # fmt: skip
        for other in runs[1:]:
            assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_clamped_colours_receive_only_gradients_that_increase_them(backend: Backend) -> None:
    """With ``clamp_color_gradient``, as in 3DGS, they receive none."""
    cam, sh = camera(20, 20), torch.zeros(1, 1, 3)
    sh[..., 0], sh[..., 1], sh[..., 2] = -5.0, -5.0, 0.5  # red and green under zero
    scene = (
        torch.tensor([[0.0, 0.0, 4.0]]), torch.full((1, 3), -1.0), torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([2.0]), sh,
    )  # fmt: skip
    fwd = backend.forward(*scene, cam, RasterOptions(sh_degree=0))
    assert fwd.color[..., :2].max() == 0 and fwd.color[..., 2].max() > 0.5
    d_color = torch.ones(20, 20, 3) * torch.tensor([-1.0, 1.0, 1.0])  # brighter, darker, darker
    found = backend.backward(fwd, d_color).sh[0, 0]
    assert found[0] < 0 and found[1] == 0 and found[2] > 0
    assert found[0] == -found[2]
    options = RasterOptions(sh_degree=0, clamp_color_gradient=True)
    clamped = backend.backward(backend.forward(*scene, cam, options), d_color).sh[0, 0]
    assert clamped[0] == clamped[1] == 0 and clamped[2] == found[2]
    leaf = sh.clone().requires_grad_()
    (reference.render(*scene[:4], leaf, cam, options)[1].color * d_color).sum().backward()
    assert leaf.grad is not None
    torch.testing.assert_close(clamped, leaf.grad[0, 0], rtol=1e-5, atol=1e-6)


def test_a_step_against_the_gradient_lowers_the_loss(backend: Backend) -> None:
    """Forward and backward are consistent: the loss decreases as the gradient predicts."""
    scene, cam = random_scene(12, 400), camera(64, 48)
    target = backend.forward(*random_scene(13, 400), cam, RasterOptions()).color

    def loss(gaussians: Scene) -> tuple[float, Gradients]:
        fwd = backend.forward(*gaussians, cam, RasterOptions())
        result = backend.l1_ssim(fwd.color, target, 0.2)
        return result.loss, backend.backward(fwd, result.grad)

    before, g = loss(scene)
    grads = [getattr(g, name) for name in NAMES]
    slope = float(sum((t.double() ** 2).sum() for t in grads))
    rate = 0.002 / slope
    after, _ = loss(tuple(t - rate * d for t, d in zip(scene, grads, strict=True)))  # type: ignore
    assert after - before == pytest.approx(-0.002, rel=0.3)


@pytest.mark.parametrize("antialias", [False, True])
def test_a_part_of_an_image_is_rendered_as_the_whole_is(backend: Backend, antialias: bool) -> None:
    """This holds also for Gaussians whose Jacobian would be clamped to the frustum of the part."""
    scene, whole = random_scene(8, 400, size=0.4), camera(96, 80)
    left, top, width, height = 37, 21, 23, 30
    part = replace(
        whole, width=width, height=height, cx=whole.cx - left, cy=whole.cy - top, part_of=whole
    )
    options = RasterOptions(antialias=antialias)
    expected = backend.forward(*scene, whole, options).color
    expected = expected[top : top + height, left : left + width]
    torch.testing.assert_close(
        backend.forward(*scene, part, options).color, expected, atol=2e-5, rtol=0
    )
    alone = backend.forward(*scene, replace(part, part_of=None), options).color
    assert (alone - expected).abs().max() > 1e-3
    _, _, image = reference_image(scene, part, options)
    assert relative(backend.forward(*scene, part, options).color, image.color) < 1e-5
