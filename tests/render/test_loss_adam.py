"""The loss and the optimisers compared with the reference, scikit-image and torch.optim."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch

from pipeline.render import (
    Backend,
    DenseAdam,
    FrameAdam,
    RasterCamera,
    RasterOptions,
    ShAdam,
    reference,
)
from tests.render.scenes import Scene, camera, random_scene, relative


def images(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    gen = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=gen)
    rendered = (target + 0.2 * torch.randn(height, width, 3, generator=gen)).clamp(0, 1)
    return rendered, target


@pytest.mark.parametrize("size", [(40, 53), (1, 1), (3, 200), (17, 5)])
@pytest.mark.parametrize("kind", ["float", "bytes", "masked", "byte mask"])
@pytest.mark.parametrize("square", [0.0, 2.5])
def test_loss_equals_the_reference(
    backend: Backend, size: tuple[int, int], kind: str, square: float
) -> None:
    rendered, target = images(*size)
    mask = torch.rand(*size, generator=torch.Generator().manual_seed(5)) > 0.7
    if kind != "float":
        target = (target * 255).round().byte()
    use = {"masked": mask, "byte mask": mask.byte() * 7}.get(kind)
    found = backend.l1_ssim(rendered, target, 0.2, use, square)
    leaf = rendered.double().requires_grad_()
    loss, error, ssim = reference.l1_ssim(leaf, target, 0.2, None if use is None else mask, square)
    (grad,) = torch.autograd.grad(loss, leaf)
    assert found.loss == pytest.approx(loss.item(), abs=1e-6)
    assert found.error == pytest.approx(error.item(), abs=1e-6)
    assert found.ssim == pytest.approx(ssim.item(), abs=1e-6)
    assert relative(found.grad, grad) <= 1e-5
    if use is not None:
        assert not found.grad[mask].any()


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
    _, ssim_map = structural_similarity(
        rendered.double().numpy(), target.double().numpy(), channel_axis=-1, data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True, truncate=3.5,
    )  # fmt: skip
    inside = torch.zeros(48, 60, dtype=torch.bool)
    inside[5:-5, 5:-5] = True
    # Border pixels are masked and equal in both images: the mean is over the inside.
    both = torch.where(inside[..., None], rendered, target)
    _, map_of_both = structural_similarity(
        both.double().numpy(), target.double().numpy(), channel_axis=-1, data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True, truncate=3.5,
    )  # fmt: skip
    found = backend.l1_ssim(rendered, target, 1.0, ~inside)
    assert found.ssim == pytest.approx(float(map_of_both[5:-5, 5:-5].mean()), abs=1e-6)
    assert abs(found.ssim - float(ssim_map[5:-5, 5:-5].mean())) > 1e-6  # the mask matters


def test_the_loss_of_a_fully_masked_image_is_zero(backend: Backend) -> None:
    rendered, target = images(9, 9)
    found = backend.l1_ssim(rendered, target, 0.2, torch.ones(9, 9, dtype=torch.bool))
    assert found.loss == 0 and not found.grad.any()


def test_masked_pixels_may_have_any_value(backend: Backend) -> None:
    rendered, target = images(20, 20)
    mask = torch.zeros(20, 20, dtype=torch.bool)
    mask[4:9, 3:7] = True
    before = backend.l1_ssim(rendered, target, 0.2, mask)
    rendered[mask] = torch.nan
    after = backend.l1_ssim(rendered, target, 0.2, mask)
    assert after.loss == before.loss and torch.equal(after.grad, before.grad)


@pytest.mark.parametrize("shape", [(1,), (15,), (16,), (1001, 3), (7, 4, 3), (0, 3)])
def test_adam_equals_torch(backend: Backend, shape: tuple[int, ...]) -> None:
    gen = torch.Generator().manual_seed(2)
    ours = torch.randn(shape, generator=gen)
    theirs = ours.double().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=1e-2, betas=(0.9, 0.999), eps=1e-15)
    m, v = torch.zeros(shape), torch.zeros(shape)
    for step in range(1, 20):
        grad = torch.randn(shape, generator=gen) * 10.0 ** (step % 5 - 3)
        grad[..., :1] = 0
        backend.adam_step(ours, grad, DenseAdam(m, v, 1e-2, step))
        theirs.grad = grad.double()
        optimizer.step()
    assert torch.allclose(ours.double(), theirs.detach(), rtol=0, atol=2e-6)


@pytest.mark.parametrize(("rows", "columns"), [(11, 3), (37, 12), (5, 27), (129, 48)])
def test_learning_rates_repeat_over_rows(backend: Backend, rows: int, columns: int) -> None:
    gen = torch.Generator().manual_seed(3)
    rates = torch.rand(columns, generator=gen, dtype=torch.float64).tolist()
    ours, grad = (torch.randn(rows, columns, generator=gen) for _ in range(2))
    expected = [ours[:, c].double().clone() for c in range(columns)]
    m, v = torch.zeros_like(ours), torch.zeros_like(ours)
    for step in (1, 2, 3):
        backend.adam_step(ours, grad, DenseAdam(m, v, rates, step))
    for column, rate in enumerate(rates):
        m64, v64 = (torch.zeros(rows, dtype=torch.float64) for _ in range(2))
        for step in (1, 2, 3):
            g64 = grad[:, column].double()
            reference.adam_step(expected[column], g64, DenseAdam(m64, v64, rate, step))
    assert torch.allclose(ours.double(), torch.stack(expected, 1), rtol=0, atol=2e-6)


@pytest.mark.parametrize(("rows", "columns"), [(1, 3), (16, 4), (37, 3), (1001, 4), (0, 3)])
def test_adam_with_shared_second_moments_equals_the_reference(
    backend: Backend, rows: int, columns: int
) -> None:
    gen = torch.Generator().manual_seed(5)
    ours = torch.randn(rows, columns, generator=gen)
    theirs = ours.double()
    m, v = torch.zeros_like(ours), torch.zeros(rows, 1)
    m64, v64 = m.double(), v.double()
    for step in range(1, 20):
        grad = torch.randn(rows, columns, generator=gen) * 10.0 ** (step % 5 - 3)
        grad[:1] = 0
        backend.adam_step(ours, grad, DenseAdam(m, v, 1e-2, step))
        reference.adam_step(theirs, grad.double(), DenseAdam(m64, v64, 1e-2, step))
    assert torch.allclose(ours.double(), theirs, rtol=0, atol=4e-6)
    assert torch.allclose(v.double(), v64, rtol=1e-5, atol=0)


class Framed(NamedTuple):
    """Parameters and state of ``frame_adam``."""

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    adam: FrameAdam
    backend: Backend

    @staticmethod
    def of(
        backend: Backend, means: torch.Tensor, quats: torch.Tensor, log_scales: torch.Tensor
    ) -> Framed:
        moments = torch.zeros(4, *means.shape, dtype=means.dtype)
        adam = FrameAdam(*moments, 1e-2, 3e-3, 1)
        return Framed(means.clone(), quats.clone(), log_scales.clone(), adam, backend)

    @staticmethod
    def random(backend: Backend, rows: int, seed: int) -> Framed:
        gen = torch.Generator().manual_seed(seed)
        means, log_scales = (torch.randn(rows, 3, generator=gen) for _ in range(2))
        return Framed.of(backend, means, 3 * torch.randn(rows, 4, generator=gen), log_scales)

    def double(self) -> Framed:
        doubles = self.means.double(), self.quats.double(), self.log_scales.double()
        return Framed.of(self.backend, *doubles)

    def step(self, number: int, d_means: torch.Tensor, d_quats: torch.Tensor) -> None:
        update = (
            self.backend.frame_adam if self.means.dtype == torch.float32 else reference.frame_adam
        )
        adam = replace(self.adam, step=number)
        update(self.means, self.quats, self.log_scales, d_means, d_quats, adam)


@pytest.mark.parametrize("rows", [1, 16, 37, 1001, 0])
def test_frame_adam_equals_the_reference(backend: Backend, rows: int) -> None:
    ours = Framed.random(backend, rows, 5)
    ours.quats[:1] = 0  # not updated
    theirs = ours.double()
    before = ours.quats.clone()
    gen = torch.Generator().manual_seed(6)
    for step in range(1, 20):
        scale = 10.0 ** (step % 5 - 3)
        d_means = torch.randn(rows, 3, generator=gen) * scale
        d_quats = torch.randn(rows, 4, generator=gen) * scale
        d_means[1:2] = 0
        ours.step(step, d_means, d_quats)
        theirs.step(step, d_means.double(), d_quats.double())
    assert torch.allclose(ours.means.double(), theirs.means, rtol=1e-5, atol=1e-5)
    assert torch.allclose(ours.quats.double(), theirs.quats, rtol=1e-5, atol=1e-5)
    for a, b in ((ours.adam.mean_avg_sq, theirs.adam.mean_avg_sq),
                 (ours.adam.rotation_avg_sq, theirs.adam.rotation_avg_sq)):  # fmt: skip
        assert torch.allclose(a.double(), b, rtol=1e-3, atol=1e-6)
    assert torch.equal(ours.quats[:1], before[:1])


def test_frame_adam_is_equivariant_under_similarities(backend: Backend) -> None:
    """x -> c T x: gradients of means are multiplied by T / c, quaternions from the left."""
    gen = torch.Generator().manual_seed(7)
    original = Framed.random(backend, 50, 8)
    rotation = torch.randn(4, generator=gen, dtype=torch.float64)
    rotation /= rotation.norm()
    matrix, size = reference.rotation_from_quat(rotation[None])[0], 7.0
    w, x, y, z = rotation.tolist()
    left = torch.tensor(
        [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64
    )
    world = Framed.of(
        backend,
        (size * original.means.double() @ matrix.T).float(),
        (original.quats.double() @ left.T).float(),
        original.log_scales + math.log(size),
    )
    for step in range(1, 10):
        d_means = torch.randn(50, 3, generator=gen, dtype=torch.float64)
        d_quats = torch.randn(50, 4, generator=gen, dtype=torch.float64)
        original.step(step, d_means.float(), d_quats.float())
        world.step(step, (d_means @ matrix.T / size).float(), (d_quats @ left.T).float())
    means, quats = size * original.means.double() @ matrix.T, original.quats.double() @ left.T
    assert torch.allclose(world.means.double(), means, rtol=0, atol=size * 1e-5)
    assert torch.allclose(world.quats.double(), quats, rtol=0, atol=1e-5)


def test_frame_adam_steps_are_relative_to_the_scales(backend: Backend) -> None:
    """Also for scales and gradients that overflow float32."""
    log_scales = torch.tensor([[0.0, -3.0, 2.0], [-200.0, 200.0, torch.nan], [0.0, 0.0, 0.0]])
    quats = torch.tensor([[1.0, 0, 0, 0], [1.0, 0, 0, 0], [torch.inf, torch.nan, 1e30, 0]])
    scene = Framed.of(backend, torch.zeros(3, 3), quats, log_scales)
    d_means = torch.tensor([[1.0, -2.0, 0.5], [1e30, 1e30, 1e30], [1.0, 1.0, 1.0]])
    scene.step(1, d_means, torch.zeros(3, 4))
    assert torch.allclose(scene.means[0], -d_means[0].sign() * 1e-2 * log_scales[0].exp())
    assert scene.means.isfinite().all()
    assert all(moment.isfinite().all() for moment in (scene.adam.mean_avg, scene.adam.mean_avg_sq))


def test_adam_with_shared_second_moments_is_equivariant_under_rotation(backend: Backend) -> None:
    gen = torch.Generator().manual_seed(6)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=gen, dtype=torch.float64))[0]
    rows = torch.randn(50, 3, generator=gen, dtype=torch.float64)
    rotated = (rows @ rotation.T).float()
    ours = rows.float()
    moments = [(torch.zeros(50, 3), torch.zeros(50, 1)) for _ in range(2)]
    for step in range(1, 10):
        grad = torch.randn(50, 3, generator=gen, dtype=torch.float64)
        gradients = grad, grad @ rotation.T
        for param, gradient, state in zip((ours, rotated), gradients, moments, strict=True):
            backend.adam_step(param, gradient.float(), DenseAdam(*state, 1e-2, step))
    assert torch.allclose(rotated.double(), ours.double() @ rotation.T, rtol=0, atol=1e-5)


def test_invalid_arguments_of_adam_are_errors(backend: Backend) -> None:
    a = torch.zeros(4, 4)
    with pytest.raises(ValueError, match="contiguous"):
        backend.adam_step(a.T[:, :2], a, DenseAdam(a, a, 0.1, 1))
    with pytest.raises(ValueError, match="shapes differ"):
        backend.adam_step(a, torch.zeros(4), DenseAdam(a, a, 0.1, 1))
    with pytest.raises(ValueError, match="step"):
        backend.adam_step(a, a, DenseAdam(a, a, 0.1, 0))
    with pytest.raises(ValueError, match="one lr"):
        backend.adam_step(a, a, DenseAdam(a, torch.zeros(4, 1), [0.1, 0.2], 1))
    with pytest.raises(ValueError, match="shapes differ"):
        b = torch.zeros(4, 5)
        backend.adam_step(b, b, DenseAdam(b, torch.zeros(4, 1), 0.1, 1))
    framed = Framed.random(backend, 4, 0)
    with pytest.raises(ValueError, match="expected"):
        framed.step(1, torch.zeros(4, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="expected"):
        framed.step(1, torch.zeros(5, 3), torch.zeros(4, 4))
    with pytest.raises(ValueError, match="contiguous"):
        framed.step(1, torch.zeros(3, 4).T, torch.zeros(4, 4))
    with pytest.raises(ValueError, match="step"):
        framed.step(0, torch.zeros(4, 3), torch.zeros(4, 4))


def sh_scene(degree: int) -> tuple[Scene, RasterCamera, torch.Tensor]:
    """A scene that is partly behind the camera, and a gradient on the image."""
    scene, cam = random_scene(5, 333, degree=degree), camera(70, 50)
    scene[0][::3, 2] *= -1  # behind the camera
    d_color = torch.randn(50, 70, 3, generator=torch.Generator().manual_seed(9))
    d_color[:, :20] = 0.0  # no gradient there
    return scene, cam, d_color


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_adam_equals_the_reference(backend: Backend, degree: int) -> None:
    scene, cam, d_color = sh_scene(degree)
    gen = torch.Generator().manual_seed(4)
    fwd = backend.forward(*scene, cam, RasterOptions(sh_degree=degree))
    plain = backend.backward(fwd, d_color)
    sh = scene[4]
    # Some were updated last many steps ago.
    last = torch.randint(0, 1000, (len(sh),), generator=gen, dtype=torch.int32)
    last[::2] = 998
    ours = ShAdam(
        1e-3 * torch.randn(sh.shape, generator=gen), 1e-5 * torch.rand(sh.shape, generator=gen),
        last, 0.01, 0.002, 1000,
    )  # fmt: skip
    theirs = dataclasses.replace(
        ours,
        exp_avg=ours.exp_avg.double(),
        exp_avg_sq=ours.exp_avg_sq.double(),
        last=ours.last.clone(),
    )
    expected, untouched = sh.double(), ours.exp_avg.clone()
    gradients = (plain.means, plain.log_scales, plain.quats, plain.opacity_logits, plain.sh)
    updated = torch.cat([g.reshape(len(sh), -1) for g in gradients], 1).any(1)
    reference.sh_adam(expected, plain.sh.double(), updated, theirs)
    fused = backend.backward(fwd, d_color, sh_adam=ours)
    # Some visible Gaussians have no gradient.
    assert 0 < updated.sum() < (fwd.radii > 0).sum() < len(sh)
    assert torch.allclose(sh.double(), expected, rtol=0, atol=2e-6)
    assert relative(ours.exp_avg, theirs.exp_avg) < 1e-5
    assert relative(ours.exp_avg_sq, theirs.exp_avg_sq) < 1e-5
    assert torch.equal(ours.last, theirs.last)
    assert torch.equal(ours.exp_avg[~updated], untouched[~updated])
    assert len(fused.sh) == 0 and torch.equal(fused.means, plain.means)


def test_sh_adam_approximates_dense_adam_after_skipped_steps() -> None:
    """With a gradient in every tenth step, the parameter equals dense Adam's up to the bias
    corrections of the skipped steps."""
    gen = torch.Generator().manual_seed(6)
    dense = torch.randn(200, 1, 3, generator=gen, dtype=torch.float64)
    sparse, (m, v) = dense.clone(), torch.zeros(2, 200, 1, 3, dtype=torch.float64)
    state = ShAdam(
        torch.zeros_like(dense), torch.zeros_like(dense),
        torch.zeros(200, dtype=torch.int32), 1e-3, 1e-3, 1,
    )  # fmt: skip
    updated = torch.ones(200, dtype=torch.bool)
    start = dense.clone()
    for step in range(1, 2001):
        seen = step % 10 == 0
        grad = torch.randn(dense.shape, generator=gen, dtype=torch.float64) + 0.3
        gradient = grad if seen else torch.zeros_like(grad)
        reference.adam_step(dense, gradient, DenseAdam(m, v, 1e-3, step))
        if seen:
            reference.sh_adam(sparse, grad, updated, dataclasses.replace(state, step=step))
    assert (sparse - dense).norm() < 0.01 * (dense - start).norm()


def test_sh_adam_with_invalid_moments_is_an_error(backend: Backend) -> None:
    scene, cam, d_color = sh_scene(1)
    fwd = backend.forward(*scene, cam, RasterOptions(sh_degree=1))
    like, last = torch.zeros_like(scene[4]), torch.zeros(333, dtype=torch.int32)
    for wrong, message in (
        (ShAdam(like[:5], like, last, 0.1, 0.1, 1), "moments"),
        (ShAdam(like, like, last.long(), 0.1, 0.1, 1), "last"),
        (ShAdam(like, like, last, 0.1, 0.1, 0), "step"),
    ):
        with pytest.raises(ValueError, match=message):
            backend.backward(fwd, d_color, sh_adam=wrong)


def test_sh_adam_stays_finite_for_gradients_whose_squares_overflow(backend: Backend) -> None:
    scene, cam, d_color = sh_scene(3)
    fwd = backend.forward(*scene, cam, RasterOptions())
    adam = ShAdam(
        torch.zeros_like(scene[4]), torch.zeros_like(scene[4]),
        torch.zeros(333, dtype=torch.int32), 0.1, 0.1, 1,
    )  # fmt: skip
    for step in (1, 2, 9):
        backend.backward(fwd, 1e25 * d_color, sh_adam=dataclasses.replace(adam, step=step))
    assert scene[4].isfinite().all()
