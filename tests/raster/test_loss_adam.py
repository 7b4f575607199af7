"""The fused loss and optimizer against the twin, scikit-image and torch.optim."""

from __future__ import annotations

import pytest
import torch

from pipeline import raster
from pipeline.raster import twin
from tests.raster.scenes import relative


def images(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    gen = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=gen)
    rendered = (target + 0.2 * torch.randn(height, width, 3, generator=gen)).clamp(0, 1)
    return rendered, target


@pytest.mark.parametrize("size", [(40, 53), (1, 1), (3, 200), (17, 5)])
@pytest.mark.parametrize("kind", ["float", "bytes", "masked", "byte mask"])
def test_loss_matches_the_twin(size: tuple[int, int], kind: str) -> None:
    rendered, target = images(*size)
    mask = torch.rand(*size, generator=torch.Generator().manual_seed(5)) > 0.7
    if kind != "float":
        target = (target * 255).round().byte()
    use = {"masked": mask, "byte mask": mask.byte() * 7}.get(kind)
    found = raster.l1_ssim(rendered, target, 0.2, use)
    leaf = rendered.double().requires_grad_()
    loss, l1, ssim = twin.l1_ssim(leaf, target, 0.2, None if use is None else mask)
    (grad,) = torch.autograd.grad(loss, leaf)
    assert found.loss == pytest.approx(loss.item(), abs=1e-6)
    assert found.l1 == pytest.approx(l1.item(), abs=1e-6)
    assert found.ssim == pytest.approx(ssim.item(), abs=1e-6)
    assert relative(found.grad, grad) <= 1e-5
    if use is not None:
        assert not found.grad[mask].any()


def test_flat_images_keep_their_digits() -> None:
    """Variances are differences of near numbers; on a flat bright image float32 must still do."""
    target = torch.full((40, 40, 3), 0.97)
    rendered = target + 1e-3 * torch.randn(40, 40, 3, generator=torch.Generator().manual_seed(1))
    leaf = rendered.double().requires_grad_()
    loss, _, _ = twin.l1_ssim(leaf, target, 1.0)
    (grad,) = torch.autograd.grad(loss, leaf)
    found = raster.l1_ssim(rendered, target, 1.0)
    assert found.loss == pytest.approx(loss.item(), abs=2e-5)
    assert relative(found.grad, grad) <= 1e-2


def test_ssim_is_scikit_images_away_from_the_border() -> None:
    from skimage.metrics import structural_similarity

    rendered, target = images(48, 60)
    _, ssim_map = structural_similarity(
        rendered.double().numpy(), target.double().numpy(), channel_axis=-1, data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True, truncate=3.5,
    )  # fmt: skip
    inside = torch.zeros(48, 60, dtype=torch.bool)
    inside[5:-5, 5:-5] = True
    # Only border pixels masked and alike on both: the mean is over the inside.
    both = torch.where(inside[..., None], rendered, target)
    _, map_of_both = structural_similarity(
        both.double().numpy(), target.double().numpy(), channel_axis=-1, data_range=1.0,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True, truncate=3.5,
    )  # fmt: skip
    found = raster.l1_ssim(rendered, target, 1.0, ~inside)
    assert found.ssim == pytest.approx(float(map_of_both[5:-5, 5:-5].mean()), abs=1e-6)
    assert abs(found.ssim - float(ssim_map[5:-5, 5:-5].mean())) > 1e-6  # the mask matters


def test_everything_masked_is_no_loss() -> None:
    rendered, target = images(9, 9)
    found = raster.l1_ssim(rendered, target, 0.2, torch.ones(9, 9, dtype=torch.bool))
    assert found.loss == 0 and not found.grad.any()


def test_masked_pixels_may_hold_anything() -> None:
    rendered, target = images(20, 20)
    mask = torch.zeros(20, 20, dtype=torch.bool)
    mask[4:9, 3:7] = True
    before = raster.l1_ssim(rendered, target, 0.2, mask)
    rendered[mask] = torch.nan
    after = raster.l1_ssim(rendered, target, 0.2, mask)
    assert after.loss == before.loss and torch.equal(after.grad, before.grad)


@pytest.mark.parametrize("shape", [(1,), (15,), (16,), (1001, 3), (7, 4, 3), (0, 3)])
def test_adam_takes_torchs_steps(shape: tuple[int, ...]) -> None:
    gen = torch.Generator().manual_seed(2)
    ours = torch.randn(shape, generator=gen)
    theirs = ours.double().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=1e-2, betas=(0.9, 0.999), eps=1e-15)
    m, v = torch.zeros(shape), torch.zeros(shape)
    for step in range(1, 20):
        grad = torch.randn(shape, generator=gen) * 10.0 ** (step % 5 - 3)
        grad[..., :1] = 0
        raster.adam_step(ours, grad, m, v, 1e-2, step)
        theirs.grad = grad.double()
        optimizer.step()
    assert torch.allclose(ours.double(), theirs.detach(), rtol=0, atol=2e-6)


@pytest.mark.parametrize(("rows", "columns"), [(11, 3), (37, 12), (5, 27), (129, 48)])
def test_rates_repeat_over_the_rows(rows: int, columns: int) -> None:
    gen = torch.Generator().manual_seed(3)
    rates = torch.rand(columns, generator=gen, dtype=torch.float64).tolist()
    ours, grad = (torch.randn(rows, columns, generator=gen) for _ in range(2))
    expected = [ours[:, c].double().clone() for c in range(columns)]
    m, v = torch.zeros_like(ours), torch.zeros_like(ours)
    for step in (1, 2, 3):
        raster.adam_step(ours, grad, m, v, rates, step)
    for column, rate in enumerate(rates):
        m64, v64 = (torch.zeros(rows, dtype=torch.float64) for _ in range(2))
        for step in (1, 2, 3):
            g64 = grad[:, column].double()
            twin.adam_step(expected[column], g64, m64, v64, rate, step)
    assert torch.allclose(ours.double(), torch.stack(expected, 1), rtol=0, atol=2e-6)


def test_adam_refuses_what_it_cannot_update_in_place() -> None:
    a = torch.zeros(4, 4)
    with pytest.raises(ValueError, match="contiguous"):
        raster.adam_step(a.T[:, :2], a, a, a, 0.1, 1)
    with pytest.raises(ValueError, match="shapes differ"):
        raster.adam_step(a, torch.zeros(4), a, a, 0.1, 1)
    with pytest.raises(ValueError, match="step"):
        raster.adam_step(a, a, a, a, 0.1, 0)
