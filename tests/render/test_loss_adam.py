"""The loss and the optimisers compared with the reference, scikit-image and torch.optim."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from pipeline.render import (
    AdamRates,
    Backend,
    FrameMoments,
    Moments,
    RasterCamera,
    RasterOptions,
    ShAdam,
    reference,
    reference_adam,
)
from tests.render.scenes import Scene, camera, random_scene, relative


def normal(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def images(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    target = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))
    return (target + 0.2 * normal(height, width, 3, seed=seed)).clamp(0, 1), target


@pytest.mark.parametrize("size", [(40, 53), (1, 1), (3, 200), (17, 5)])
@pytest.mark.parametrize("kind", ["float", "bytes", "masked", "byte mask"])
@pytest.mark.parametrize("square", [0.0, 2.5])
def test_loss_equals_the_reference(
    any_backend: Backend, size: tuple[int, int], kind: str, square: float
) -> None:
    rendered, target = images(*size)
    mask = torch.rand(*size, generator=torch.Generator().manual_seed(5)) > 0.7
    if kind != "float":
        target = (target * 255).round().byte()
    use = {"masked": mask, "byte mask": mask.byte() * 7}.get(kind)
    found = any_backend.l1_ssim(rendered, target, 0.2, use, square)
    leaf = rendered.double().requires_grad_()
    loss, error, ssim = reference.l1_ssim(leaf, target, 0.2, None if use is None else mask, square)
    (grad,) = torch.autograd.grad(loss, leaf)
    assert found.loss == pytest.approx(loss.item(), abs=1e-6)
    assert found.error == pytest.approx(error.item(), abs=1e-6)
    assert found.ssim == pytest.approx(ssim.item(), abs=1e-6)
    squared = reference.mean_squared_error(leaf, target, None if use is None else mask)
    assert found.squared_error == pytest.approx(squared.item(), rel=1e-5)
    assert found.grad.dtype == torch.float32
    assert relative(found.grad, grad) <= 1e-5
    if use is not None:
        assert not found.grad[mask].any()


@pytest.mark.parametrize("shape", [(3,), (40, 53, 3)])
@pytest.mark.parametrize("masked", [False, True])
def test_a_factor_is_that_of_the_rendered_image(
    any_backend: Backend, shape: tuple[int, ...], masked: bool
) -> None:
    rendered, target = images(40, 53)
    factor = 1 + 0.2 * normal(*shape, seed=3)
    mask = torch.rand(40, 53, generator=torch.Generator().manual_seed(5)) > 0.7 if masked else None
    found = any_backend.l1_ssim(rendered, target, 0.2, mask, 2.5, factor=factor)
    leaf = rendered.double().requires_grad_()
    lit = leaf * factor.double()
    loss, _, _ = reference.l1_ssim(lit, target, 0.2, mask, 2.5)
    (grad,) = torch.autograd.grad(loss, leaf)
    squared = reference.mean_squared_error(lit, target, mask)
    assert found.loss == pytest.approx(loss.item(), abs=1e-6)
    assert found.squared_error == pytest.approx(squared.item(), rel=1e-5)
    assert relative(found.grad, grad) <= 1e-5


def test_a_factor_of_another_size_is_an_error(backend: Backend) -> None:
    with pytest.raises(ValueError, match="factor"):
        backend.l1_ssim(*images(9, 9), 0.2, factor=torch.ones(9, 8, 3))


def test_loss_of_flat_images_is_accurate(backend: Backend) -> None:
    """Variances are differences of nearly equal numbers on a flat, bright image."""
    target = torch.full((40, 40, 3), 0.97)
    rendered = target + 1e-3 * torch.randn(40, 40, 3, generator=torch.Generator().manual_seed(1))
    leaf = rendered.double().requires_grad_()
    loss, _, _ = reference.l1_ssim(leaf, target, 1.0)
    (grad,) = torch.autograd.grad(loss, leaf)
    found = backend.l1_ssim(rendered, target, 1.0)
    assert found.loss == pytest.approx(loss.item(), abs=2e-5)
    assert relative(found.grad, grad) <= 1e-2


def test_ssim_equals_scikit_image_away_from_the_border(backend: Backend) -> None:
    from skimage.metrics import structural_similarity

    rendered, target = images(48, 60)
    inside = torch.zeros(48, 60, dtype=torch.bool)
    inside[5:-5, 5:-5] = True
    # Border pixels are masked and equal in both images: the mean is over the inside.
    both = torch.where(inside[..., None], rendered, target)
    expected, without_mask = (
        structural_similarity(
            image.double().numpy(), target.double().numpy(), channel_axis=-1, data_range=1.0,
            gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True, truncate=3.5,
        )[1][5:-5, 5:-5].mean()
        for image in (both, rendered)
    )  # fmt: skip
    found = backend.l1_ssim(rendered, target, 1.0, ~inside)
    assert found.ssim == pytest.approx(float(expected), abs=1e-6)
    assert abs(found.ssim - float(without_mask)) > 1e-6  # the mask matters


def test_the_loss_of_a_fully_masked_image_is_zero(backend: Backend) -> None:
    rendered, target = images(9, 9)
    found = backend.l1_ssim(rendered, target, 0.2, torch.ones(9, 9, dtype=torch.bool))
    assert found.loss == 0 and found.squared_error == 0 and not found.grad.any()


def test_masked_pixels_may_have_any_value(backend: Backend) -> None:
    rendered, target = images(20, 20)
    mask = torch.zeros(20, 20, dtype=torch.bool)
    mask[4:9, 3:7] = True
    before = backend.l1_ssim(rendered, target, 0.2, mask)
    rendered[mask] = torch.nan
    after = backend.l1_ssim(rendered, target, 0.2, mask)
    assert after.loss == before.loss and torch.equal(after.grad, before.grad)


def noisy_gradients(*shape: int, seed: int) -> list[tuple[int, torch.Tensor]]:
    """19 steps with gradients of different sizes, zero for the first rows."""
    generator = torch.Generator().manual_seed(seed)
    steps = []
    for step in range(1, 20):
        grad = torch.randn(shape, generator=generator) * 10.0 ** (step % 5 - 3)
        grad[:1] = 0
        steps.append((step, grad))
    return steps


@pytest.mark.parametrize("shape", [(1,), (15,), (16,), (1001, 3), (7, 4, 3), (0, 3)])
def test_adam_equals_torch(any_backend: Backend, shape: tuple[int, ...]) -> None:
    ours = normal(*shape, seed=2)
    theirs = ours.double().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=1e-2, betas=(0.9, 0.999), eps=1e-15)
    moments = Moments(torch.zeros(shape), torch.zeros(shape))
    for step, grad in noisy_gradients(*shape, seed=3):
        any_backend.adam_step(ours, grad, moments, AdamRates(1e-2, step))
        theirs.grad = grad.double()
        optimizer.step()
    assert torch.allclose(ours.double(), theirs.detach(), rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("rows", "columns", "shared"),
    [
        (11, 3, False), (37, 12, False), (5, 27, False), (129, 48, False),
        (1, 3, True), (16, 4, True), (37, 3, True), (1001, 4, True), (0, 3, True),
    ],
)  # fmt: skip
def test_adam_with_a_rate_for_each_column_or_a_moment_for_each_row_equals_the_reference(
    any_backend: Backend, rows: int, columns: int, shared: bool
) -> None:
    ours = normal(rows, columns, seed=5)
    theirs = ours.double()
    moments = Moments(torch.zeros_like(ours), torch.zeros(rows, 1 if shared else columns))
    doubles = Moments(moments.exp_avg.double(), moments.exp_avg_sq.double())
    lr = 1e-2 if shared else normal(columns, seed=3).abs().mul(1e-2).tolist()
    for step, grad in noisy_gradients(rows, columns, seed=6):
        any_backend.adam_step(ours, grad, moments, AdamRates(lr, step))
        reference_adam.adam_step(theirs, grad.double(), doubles, AdamRates(lr, step))
    assert torch.allclose(ours.double(), theirs, rtol=0, atol=4e-6)
    assert torch.allclose(moments.exp_avg_sq.double(), doubles.exp_avg_sq, rtol=1e-5, atol=0)


class Framed:
    """Parameters and state of ``frame_adam``."""

    def __init__(
        self, backend: Backend, means: torch.Tensor, quats: torch.Tensor, log_scales: torch.Tensor
    ):
        self.backend = backend
        self.means, self.quats, self.log_scales = means.clone(), quats.clone(), log_scales
        zeros = torch.zeros(4, *means.shape, dtype=means.dtype)
        self.moments = FrameMoments(Moments(*zeros[:2]), Moments(*zeros[2:]))

    @staticmethod
    def random(backend: Backend, rows: int, seed: int) -> Framed:
        means, log_scales = normal(2, rows, 3, seed=seed)
        return Framed(backend, means, 3 * normal(rows, 4, seed=seed + 1), log_scales)

    def double(self) -> Framed:
        doubles = self.means.double(), self.quats.double(), self.log_scales.double()
        return Framed(self.backend, *doubles)

    def step(self, number: int, d_means: torch.Tensor, d_quats: torch.Tensor) -> None:
        is_double = self.means.dtype == torch.float64
        update = reference_adam.frame_adam if is_double else self.backend.frame_adam
        rates = AdamRates((1e-2, 3e-3), number)
        parameters = self.means, self.quats, self.log_scales
        update(*parameters, d_means, d_quats, self.moments, rates)


@pytest.mark.parametrize("rows", [1, 16, 37, 1001, 0])
def test_frame_adam_equals_the_reference(any_backend: Backend, rows: int) -> None:
    ours = Framed.random(any_backend, rows, 5)
    ours.quats[:1] = 0  # not updated
    theirs = ours.double()
    before = ours.quats.clone()
    for step, both in noisy_gradients(rows, 7, seed=6):
        d_means, d_quats = both[:, :3].contiguous(), both[:, 3:].contiguous()
        ours.step(step, d_means, d_quats)
        theirs.step(step, d_means.double(), d_quats.double())
    assert torch.allclose(ours.means.double(), theirs.means, rtol=1e-5, atol=1e-5)
    assert torch.allclose(ours.quats.double(), theirs.quats, rtol=1e-5, atol=1e-5)
    for name in ("means", "rotations"):
        a, b = (getattr(each.moments, name).exp_avg_sq.double() for each in (ours, theirs))
        assert torch.allclose(a, b, rtol=1e-3, atol=1e-6)
    assert torch.equal(ours.quats[:1], before[:1])


def test_frame_adam_is_equivariant_under_similarities(backend: Backend) -> None:
    """x -> c T x: gradients of means are multiplied by T / c, quaternions from the left."""
    generator = torch.Generator().manual_seed(7)
    original = Framed.random(backend, 50, 8)
    rotation = torch.randn(4, generator=generator, dtype=torch.float64)
    rotation /= rotation.norm()
    matrix, size = reference.rotation_from_quat(rotation[None])[0], 7.0
    w, x, y, z = rotation.tolist()
    left = torch.tensor(
        [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64
    )

    def moved(framed: Framed) -> tuple[torch.Tensor, torch.Tensor]:
        return size * framed.means.double() @ matrix.T, framed.quats.double() @ left.T

    means, quats = moved(original)
    world = Framed(backend, means.float(), quats.float(), original.log_scales + math.log(size))
    for step in range(1, 10):
        d_means = torch.randn(50, 3, generator=generator, dtype=torch.float64)
        d_quats = torch.randn(50, 4, generator=generator, dtype=torch.float64)
        original.step(step, d_means.float(), d_quats.float())
        world.step(step, (d_means @ matrix.T / size).float(), (d_quats @ left.T).float())
    means, quats = moved(original)
    assert torch.allclose(world.means.double(), means, rtol=0, atol=size * 1e-5)
    assert torch.allclose(world.quats.double(), quats, rtol=0, atol=1e-5)


def test_frame_adam_steps_are_relative_to_the_scales(backend: Backend) -> None:
    """This holds also for scales and gradients that overflow float32."""
    log_scales = torch.tensor([[0.0, -3.0, 2.0], [-200.0, 200.0, torch.nan], [0.0, 0.0, 0.0]])
    quats = torch.tensor([[1.0, 0, 0, 0], [1.0, 0, 0, 0], [torch.inf, torch.nan, 1e30, 0]])
    scene = Framed(backend, torch.zeros(3, 3), quats, log_scales)
    d_means = torch.tensor([[1.0, -2.0, 0.5], [1e30, 1e30, 1e30], [1.0, 1.0, 1.0]])
    scene.step(1, d_means, torch.zeros(3, 4))
    assert torch.allclose(scene.means[0], -d_means[0].sign() * 1e-2 * log_scales[0].exp())
    for tensor in (scene.means, *vars(scene.moments.means).values()):
        assert tensor.isfinite().all()


def test_adam_with_shared_second_moments_is_equivariant_under_rotation(backend: Backend) -> None:
    rotation = torch.linalg.qr(normal(3, 3, seed=6).double())[0]
    ours = normal(50, 3, seed=7)
    rotated = (ours.double() @ rotation.T).float()
    moments = [Moments(torch.zeros(50, 3), torch.zeros(50, 1)) for _ in range(2)]
    for step in range(1, 10):
        grad = normal(50, 3, seed=7 + step)
        gradients = grad, (grad.double() @ rotation.T).float()
        for param, gradient, state in zip((ours, rotated), gradients, moments, strict=True):
            backend.adam_step(param, gradient, state, AdamRates(1e-2, step))
    assert torch.allclose(rotated.double(), ours.double() @ rotation.T, rtol=0, atol=1e-5)


A, B = torch.zeros(4, 4), torch.zeros(4, 5)
COLUMN = torch.zeros(4, 1)


@pytest.mark.parametrize(
    ("message", "param", "grad", "moments", "rates"),
    [
        ("contiguous", A.T[:, :2], A, (A, A), (0.1, 1)),
        ("shapes differ", A, torch.zeros(4), (A, A), (0.1, 1)),
        ("step", A, A, (A, A), (0.1, 0)),
        ("one lr", A, A, (A, COLUMN), ([0.1, 0.2], 1)),
        ("shapes differ", B, B, (B, COLUMN), (0.1, 1)),
        ("rates", A, A, (A, A), ([], 1)),
    ],
)
def test_invalid_arguments_of_adam_are_errors(
    backend: Backend,
    message: str,
    param: torch.Tensor,
    grad: torch.Tensor,
    moments: tuple[torch.Tensor, torch.Tensor],
    rates: tuple[float, int],
) -> None:
    with pytest.raises(ValueError, match=message):
        backend.adam_step(param, grad, Moments(*moments), AdamRates(*rates))


@pytest.mark.parametrize(
    ("message", "step", "d_means", "d_quats"),
    [
        ("expected", 1, torch.zeros(4, 3), torch.zeros(4, 3)),
        ("expected", 1, torch.zeros(5, 3), torch.zeros(4, 4)),
        ("contiguous", 1, torch.zeros(3, 4).T, torch.zeros(4, 4)),
        ("step", 0, torch.zeros(4, 3), torch.zeros(4, 4)),
    ],
)
def test_invalid_arguments_of_frame_adam_are_errors(
    backend: Backend, message: str, step: int, d_means: torch.Tensor, d_quats: torch.Tensor
) -> None:
    with pytest.raises(ValueError, match=message):
        Framed.random(backend, 4, 0).step(step, d_means, d_quats)


def sh_scene(degree: int) -> tuple[Scene, RasterCamera, torch.Tensor]:
    """A scene that is partly behind the camera, and a gradient on the image."""
    scene, cam = random_scene(5, 333, degree=degree), camera(70, 50)
    scene[0][::3, 2] *= -1  # behind the camera
    d_color = normal(50, 70, 3, seed=9)
    d_color[:, :20] = 0.0  # no gradient there
    return scene, cam, d_color


@pytest.mark.parametrize(
    ("degree", "stored", "size"),
    [(0, 0, 1), (1, 1, 1), (2, 2, 1), (3, 3, 1), (0, 3, 1), (2, 3, 1), (3, 3, 1e-7), (3, 3, 1e7)],
)
def test_sh_adam_equals_the_reference(
    any_backend: Backend, degree: int, stored: int, size: float
) -> None:
    """``size`` is that of gradients and first moments: those of large images are tiny."""
    scene, cam, d_color = sh_scene(stored)
    d_color *= size
    fwd = any_backend.forward(*scene, cam, RasterOptions(sh_degree=degree))
    plain = any_backend.backward(fwd, d_color)
    sh = scene[4]
    # Some were updated last many steps ago.
    last = torch.randint(0, 1000, (len(sh),), generator=torch.manual_seed(4), dtype=torch.int32)
    last[::2] = 998
    first = (1e-3 * size * normal(*sh.shape, seed=4)).bfloat16()
    moments = Moments(first, 1e-5 * size**2 * normal(*sh.shape[:2], 1, seed=5).abs())
    for moment in vars(moments).values():
        moment[:, (degree + 1) ** 2 :] = 0  # Not used so far.
    doubles = Moments(first.clone(), moments.exp_avg_sq.double())
    ours = ShAdam(moments, last, AdamRates((0.01, 0.002), 1000))
    theirs = replace(ours, moments=doubles, last=last.clone())
    expected, untouched = sh.double(), moments.exp_avg.clone()
    gradients = (plain.means, plain.log_scales, plain.quats, plain.opacity_logits, plain.sh)
    updated = torch.cat([g.reshape(len(sh), -1) for g in gradients], 1).any(1)
    reference_adam.sh_adam(expected, plain.sh.double(), updated, theirs)
    fused = any_backend.backward(fwd, d_color, sh_adam=ours)
    # Some visible Gaussians have no gradient.
    assert 0 < updated.sum() < (fwd.radii > 0).sum() < len(sh)
    assert torch.allclose(sh.double(), expected, rtol=0, atol=2e-6)
    # All are equal but some close to the middle between two values of bfloat16.
    differ = moments.exp_avg != doubles.exp_avg
    assert differ.double().mean() < 1e-3
    torch.testing.assert_close(moments.exp_avg, doubles.exp_avg, rtol=2.0**-7, atol=1e-12 * size)
    assert relative(moments.exp_avg_sq, doubles.exp_avg_sq) < 1e-5
    assert torch.equal(ours.last, theirs.last)
    assert torch.equal(moments.exp_avg[~updated], untouched[~updated])
    assert len(fused.sh) == 0 and torch.equal(fused.means, plain.means)


def test_sh_adam_approximates_dense_adam_after_skipped_steps() -> None:
    """With a gradient in every tenth step, the parameter equals that of dense Adam with a second
    moment for each coefficient, up to the bias corrections of the skipped steps."""
    start = normal(200, 3, seed=6).double()
    dense, sparse = start.clone(), start[:, None].clone()
    of_dense = Moments(torch.zeros_like(start), torch.zeros_like(start[:, :1]))
    of_sparse = Moments(torch.zeros_like(sparse), torch.zeros_like(sparse[..., :1]))
    last, updated = torch.zeros(200, dtype=torch.int32), torch.ones(200, dtype=torch.bool)
    for step in range(1, 2001):
        seen = step % 10 == 0
        gradient = (normal(200, 3, seed=step).double() + 0.3) * seen
        reference_adam.adam_step(dense, gradient, of_dense, AdamRates(1e-3, step))
        if seen:
            adam = ShAdam(of_sparse, last, AdamRates((1e-3, 1e-3), step))
            reference_adam.sh_adam(sparse, gradient[:, None], updated, adam)
    assert (sparse[:, 0] - dense).norm() < 0.01 * (dense - start).norm()


def test_sh_adam_with_invalid_moments_is_an_error(backend: Backend) -> None:
    scene, cam, d_color = sh_scene(1)
    fwd = backend.forward(*scene, cam, RasterOptions(sh_degree=1))
    first = torch.zeros_like(scene[4], dtype=torch.bfloat16)
    second, last = torch.zeros(333, 4, 1), torch.zeros(333, dtype=torch.int32)
    moments, rates = Moments(first, second), AdamRates((0.1, 0.1), 1)
    for wrong, message in (
        (ShAdam(Moments(first[:5], second), last, rates), "moments"),
        (ShAdam(Moments(first.float(), second), last, rates), "moments"),
        (ShAdam(Moments(first, torch.zeros_like(scene[4])), last, rates), "moments"),
        (ShAdam(moments, last.long(), rates), "last"),
        (ShAdam(moments, last, replace(rates, step=0)), "step"),
        (ShAdam(moments, last, AdamRates(0.1, 1)), "expected 2 rates"),
    ):
        with pytest.raises(ValueError, match=message):
            backend.backward(fwd, d_color, sh_adam=wrong)


def test_sh_adam_stays_finite_for_gradients_whose_squares_overflow(backend: Backend) -> None:
    scene, cam, d_color = sh_scene(3)
    fwd = backend.forward(*scene, cam, RasterOptions())
    first, second = torch.zeros_like(scene[4], dtype=torch.bfloat16), torch.zeros(333, 16, 1)
    moments, last = Moments(first, second), torch.zeros(333, dtype=torch.int32)
    for step in (1, 2, 9):
        adam = ShAdam(moments, last, AdamRates((0.1, 0.1), step))
        backend.backward(fwd, 1e25 * d_color, sh_adam=adam)
    assert scene[4].isfinite().all()
