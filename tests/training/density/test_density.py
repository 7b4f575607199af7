"""Density control: rows, moments and budget are consistent; splits keep positions and extents."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.density import Gradient, Mcmc, Original
from pipeline.config.experiments import GradientExperiments, McmcExperiments, TrainExperiments
from pipeline.config.settled import TrainOptions
from pipeline.render import make_backend
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.rows import take_rows
from pipeline.splats.skybox import Sky
from pipeline.training.density import DensityStep, Strategy, make_strategy
from pipeline.training.density.gradient import GradientDensity
from pipeline.training.density.growth import (
    HALVES_OPACITY,
    LONG_AXIS,
    OTHER_AXES,
    SPLIT_SHRINK,
    sampled,
)
from pipeline.training.density.mcmc import McmcDensity, share_out
from pipeline.training.density.original import OriginalDensity
from pipeline.training.density.strategy import (
    Changes,
    Refinement,
    highest,
    not_finite,
    rotations,
)
from pipeline.training.loop.state import TrainState
from pipeline.training.optimisers.adam import Adam, AdamOptions
from tests.training.conftest import ball

STEPS = 1000  # the length of the schedule


def marked(count: int) -> tuple[Gaussians, Adam]:
    """Gaussians with moments that are equal to their row's number, from 1."""
    gaussians = ball(count, 0)
    adam = Adam(gaussians, AdamOptions(0.8, own_frames=True))
    for moments in (adam.first, adam.second):
        for tensor in moments.values():
            tensor += torch.arange(1, count + 1).view(-1, *[1] * (tensor.ndim - 1))
    return gaussians, adam


def strategy(count: int, **options: object) -> GradientDensity:
    density = GradientDensity(GradientExperiments(**options), STEPS, 1.0)  # type: ignore[arg-type]
    density.start(count)
    density.observed.seen += 1
    return density


def step_of(
    density: Strategy,
    gaussians: Gaussians,
    adam: Adam,
    *,
    densify: bool = True,
    budget: int = 1_000_000,
    seed: int = 0,
) -> DensityStep:
    """A step of the schedule after which ``density`` densifies, or another one."""
    due = next(n for n in range(STEPS, 0, -1) if density.timeline.densifies_after(n))
    number = due if densify else 1
    rng = np.random.Generator(np.random.PCG64(seed))
    steps = range(number, number + 1)
    return replace(inputs(gaussians, adam, rng, steps), budget=budget, prune=True)


def inputs(gaussians: Gaussians, adam: Adam, rng: np.random.Generator, steps: range) -> DensityStep:
    """What a strategy works on after these steps."""
    colors = gaussians.colors()
    return DensityStep(gaussians.geometry, adam.frozen, lambda: not_finite(colors), rng, steps)


def copied(
    refinement: Refinement, step: DensityStep, gaussians: Gaussians, adam: Adam
) -> Gaussians:
    """The Gaussians of a refinement; the moments become theirs."""
    adam.select(refinement.rows, refinement.fresh)
    colors = take_rows(gaussians.colors(), refinement.rows, 1)
    return Gaussians(**refinement.geometry(step).tensors(), **colors)


def refine(
    density: Strategy,
    gaussians: Gaussians,
    adam: Adam,
    *,
    densify: bool = True,
    budget: int = 1_000_000,
) -> Gaussians:
    step = step_of(density, gaussians, adam, densify=densify, budget=budget)
    return copied(density.refine(step), step, gaussians, adam)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 60), st.integers(1, 80), st.integers(0, 2**31), st.booleans())
def test_counts_moments_and_budget(count: int, budget: int, seed: int, densify: bool) -> None:
    gaussians, adam = marked(count)
    rng = np.random.default_rng(seed)
    density = strategy(count)
    density.observed.gradient_sum = torch.from_numpy(rng.uniform(0, 4e-4, count).astype(np.float32))
    gaussians.opacity_logits[torch.from_numpy(rng.random(count) < 0.2)] = -9.0
    rows = {row.numpy().tobytes(): index + 1 for index, row in enumerate(gaussians.means)}

    step = step_of(density, gaussians, adam, densify=densify, budget=budget)
    refinement = density.refine(step)
    result, changes = copied(refinement, step, gaussians, adam), refinement.changes

    assert len(result) == count - changes.pruned + changes.cloned + changes.split
    assert len(result) <= max(budget, count - changes.pruned)
    assert len(density.observed.gradient_sum) == len(density.observed.seen) == len(result)
    for name, tensor in result.tensors().items():
        assert tensor.is_contiguous()
        for moments in (adam.first, adam.second):
            assert len(moments[name]) == len(tensor)
            per_row = moments[name].reshape(len(tensor), math.prod(moments[name].shape[1:]))
            assert (per_row == per_row[:, :1]).all()
    # Whoever has moments has its own; the new have none.
    for row, moment in zip(result.means, adam.first["opacity_logits"], strict=True):
        if moment > 0:
            assert rows[row.numpy().tobytes()] == moment
    if len(result):
        survivors = int((adam.first["opacity_logits"] > 0).sum())
        assert survivors == count - changes.pruned - changes.split


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 40), st.integers(0, 2**31))
def test_a_selection_of_a_refinement_copies_the_selected_rows(count: int, seed: int) -> None:
    """In any order and without some of them, changed rows included."""
    draws = torch.Generator().manual_seed(seed)
    found = []
    which = torch.randperm(count, generator=draws)[: int(torch.randint(0, count + 1, (1,)))]
    changed = torch.nonzero(torch.rand(count, generator=draws) < 0.5)[:, 0]
    refinement = Refinement(
        rows=torch.randint(0, 10, (count,), generator=draws),
        fresh=torch.rand(count, generator=draws) < 0.5,
        changed=changed,
        values={"means": torch.rand(len(changed), 3, generator=draws)},
        changes=Changes(),
    )
    for before in (True, False):
        gaussians, adam = marked(10)
        step = step_of(strategy(10), gaussians, adam)
        if before:
            result = copied(refinement.select(which), step, gaussians, adam)
        else:
            result = copied(refinement, step, gaussians, adam).select(which)
            adam.select(which, torch.zeros(len(which), dtype=torch.bool))
        found.append([*result.tensors().values(), *adam.first.values(), *adam.second.values()])
    assert all(map(torch.equal, *found))


def test_the_budget_goes_to_the_largest_gradients() -> None:
    gaussians, adam = marked(10)
    density = strategy(10)
    density.observed.gradient_sum = torch.arange(10.0)
    result = refine(density, gaussians, adam, budget=13)
    assert len(result) == 13
    assert torch.equal(result.means[:7], gaussians.means[:7])
    assert torch.equal(result.sh[7:], gaussians.sh[[7, 8, 9, 7, 8, 9]])


def test_transparent_gaussians_with_small_gradients_are_recycled() -> None:
    """New Gaussians are transparent, but have large gradients and stay."""
    gaussians, adam = marked(40)
    gaussians.opacity_logits[:] = 2.0
    gaussians.opacity_logits[:2] = -3.0  # 0.05
    density = strategy(40, recycle_share=0.1)
    # All are above the threshold; the tenth with the smallest gradients are 0 and 2 to 4.
    density.observed.gradient_sum += torch.arange(1.0, 41.0)
    density.observed.gradient_sum[1] = 30.5
    result = refine(density, gaussians, adam, budget=40)
    assert torch.equal(result.means[:38], gaussians.means[1:39])
    assert torch.equal(result.sh[38:], gaussians.sh[[39, 39]])


def test_steps_without_the_gaussian_do_not_change_its_mean_gradient() -> None:
    gaussians, adam = marked(2)
    density = strategy(2, grad_threshold=1.0)
    density.observed.gradient_sum = torch.tensor([3.0, 3.0])
    density.observed.seen = torch.tensor([2.0, 4.0])
    assert len(refine(density, gaussians, adam)) == 3


def test_sampled_halves_keep_the_mean_and_shrink() -> None:
    one = ball(1, 4)
    count = 20_000
    halves = one.select(torch.zeros(count, dtype=torch.int64))
    values = sampled(halves, np.random.Generator(np.random.PCG64(0)))
    assert torch.allclose(values["log_scales"], one.log_scales - math.log(SPLIT_SHRINK))
    offset = (values["means"] - one.means).double()
    sigma = one.log_scales.exp().max().item()
    assert offset.mean(0).abs().max() < 5 * sigma / math.sqrt(count)
    # Drawn from the Gaussian itself: its covariance R S S R^T.
    axes = rotations(one.quats)[0].double() * one.log_scales.exp().double()
    wanted = axes @ axes.T
    assert torch.allclose(offset.T @ offset / len(offset), wanted, atol=0.03 * sigma**2)


def test_halves_stand_side_by_side_along_the_longest_axis() -> None:
    """About the old centre, with the old variance along the axis."""
    gaussians, adam = marked(5)
    gaussians.log_scales += torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    density = strategy(5)
    density.observed.gradient_sum += 1.0
    result = refine(density, gaussians, adam)
    assert len(result) == 10
    middle = (result.means[:5] + result.means[5:]) / 2
    assert torch.allclose(middle, gaussians.means, atol=1e-6)
    for k in range(5):
        longest = int(gaussians.log_scales[k].argmax())
        scales = gaussians.log_scales[k].exp()
        offset = rotations(gaussians.quats[k : k + 1])[0].T @ (result.means[k] - middle[k])
        for half in (result.log_scales[k].exp(), result.log_scales[k + 5].exp()):
            ratio = torch.full((3,), OTHER_AXES)
            ratio[longest] = LONG_AXIS
            assert torch.allclose(half / scales, ratio)
            variance = half[longest] ** 2 + offset[longest] ** 2
            assert torch.allclose(variance, scales[longest] ** 2, rtol=1e-4)
        assert offset.abs().argmax() == longest
        assert torch.allclose(offset.abs().sum(), offset[longest].abs(), atol=1e-5)
    opacity = torch.sigmoid(gaussians.opacity_logits).repeat(2)
    assert torch.allclose(torch.sigmoid(result.opacity_logits), HALVES_OPACITY * opacity)


def test_clones_are_copies() -> None:
    gaussians, adam = marked(5)
    gaussians.log_scales[:] = -9.0
    density = OriginalDensity(STEPS, extent=1.0)
    density.start(5)
    density.observed.gradient_sum += 1.0
    result = refine(density, gaussians, adam)
    for tensor in result.tensors().values():
        assert torch.equal(tensor[:5], tensor[5:])


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logits", "sh"])
def test_values_that_are_not_finite_are_removed(name: str) -> None:
    gaussians, adam = marked(6)
    gaussians.tensors()[name].view(6, -1)[2, 0] = math.nan
    result = refine(strategy(6), gaussians, adam, densify=False)
    assert len(result) == 5
    assert all(torch.isfinite(tensor).all() for tensor in result.tensors().values())


def test_an_opacity_reset_limits_opacities_and_clears_moments() -> None:
    gaussians, adam = marked(4)
    gaussians.opacity_logits[0] = -7.0
    density = strategy(4, opacity_reset_interval=1000)
    number = next(n for n in range(1, STEPS) if density.resets_opacity_after(n))
    steps = range(number, number + 1)
    update = density.after_step(inputs(gaussians, adam, np.random.default_rng(0), steps))
    assert update.opacity_reset and update.refinement is None
    TrainState.apply(SimpleNamespace(gaussians=gaussians, adam=adam), update, 1)  # type: ignore[arg-type]
    opacity = torch.sigmoid(gaussians.opacity_logits)
    assert opacity[0] < 0.001
    assert torch.allclose(opacity[1:], torch.tensor(0.01))
    assert not adam.first["opacity_logits"].any()
    assert adam.first["means"].all()


def test_the_sky_is_neither_reset_nor_too_large() -> None:
    gaussians, adam = marked(6)
    gaussians.means[0] = torch.tensor([0.0, 0.0, 1e4])
    gaussians.log_scales[:2] = 5.0
    density = GradientDensity(
        GradientExperiments(prune_scale=1.0), 30_000, 1.0, Sky(np.zeros((1, 3)))
    )
    density.start(6)
    before = gaussians.opacity_logits[0].clone()
    density.reset_opacity(gaussians.geometry, adam.frozen)
    assert gaussians.opacity_logits[0] == before
    assert torch.allclose(torch.sigmoid(gaussians.opacity_logits[1:]), torch.tensor(0.01))
    after_reset = density.reset_interval + 1
    due = next(n for n in range(after_reset, 30_000) if density.prunes_large_after(n))
    step = inputs(gaussians, adam, np.random.default_rng(0), range(due, due + 1))
    refined = density.refine(step).geometry(step)
    assert refined.log_scales.max() == 5.0 and len(refined) == 5


def mcmc(**options: object) -> McmcDensity:
    return McmcDensity(McmcExperiments(**options), STEPS, 1.0)  # type: ignore[arg-type]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 60), st.integers(1, 80), st.integers(0, 2**31), st.booleans())
def test_mcmc_counts_moments_and_budget(count: int, budget: int, seed: int, densify: bool) -> None:
    gaussians, adam = marked(count)
    faint = np.random.default_rng(seed).random(count) < 0.3
    gaussians.opacity_logits[torch.from_numpy(faint)] = -9.0
    density = mcmc(growth_share=0.2)
    step = step_of(density, gaussians, adam, densify=densify, budget=budget, seed=seed)
    refinement = density.refine(step)
    result, changes = copied(refinement, step, gaussians, adam), refinement.changes
    alive = count - int(faint.sum())
    if densify and alive:
        assert len(result) == max(count, min(budget, math.ceil(1.2 * count)))
        assert changes.relocated == count - alive
    else:
        assert len(result) == alive
        assert changes.pruned == count - alive
    for name, tensor in result.tensors().items():
        assert len(adam.first[name]) == len(tensor)
        assert len(adam.second[name]) == len(tensor)
        assert torch.isfinite(tensor).all()
    # Whoever stayed as it was has its own moments; whoever was shared out, and the new, have none.
    had = {row.numpy().tobytes(): i + 1 for i, row in enumerate(gaussians.means)}
    for row, moment in zip(result.means, adam.first["opacity_logits"], strict=True):
        assert moment in (0, had[row.numpy().tobytes()])


@pytest.mark.parametrize("parts", [1, 2, 3, 10, 50])
@pytest.mark.parametrize("opacity", [0.02, 0.5, 0.95])
def test_relocation_keeps_the_rendered_image(parts: int, opacity: float) -> None:
    """``parts`` Gaussians in one place render like the single one: the same maximum and the same
    integral along a line (equation 9)."""
    logits = torch.logit(torch.tensor([opacity]))
    new, shrink = share_out(logits, torch.tensor([parts]), 1e-6)
    x = torch.linspace(-9, 9, 4001, dtype=torch.float64)
    one = opacity * torch.exp(-0.5 * x**2)
    part = torch.sigmoid(new.double()) * torch.exp(-0.5 * (x / shrink.double().exp()) ** 2)
    many = 1 - (1 - part) ** parts
    assert many.max() == pytest.approx(opacity, rel=1e-4)
    assert many.sum() == pytest.approx(float(one.sum()), rel=1e-3)


def test_noise_moves_transparent_gaussians_along_their_axes() -> None:
    gaussians = ball(2000, 0)
    gaussians.opacity_logits[:1000] = -9.0
    gaussians.opacity_logits[1000:] = 3.0
    gaussians.quats[:] = torch.tensor([1.0, 0, 0, 0])
    gaussians.log_scales[:] = torch.tensor([-1.0, -9.0, -9.0])
    before = gaussians.means.clone()
    adam = Adam(gaussians, AdamOptions(0.8, own_frames=True))
    rng = np.random.Generator(np.random.PCG64(0))
    assert mcmc().is_due(range(1, 2))
    mcmc().after_step(replace(inputs(gaussians, adam, rng, range(1, 2)), noise_rate=1e-2))
    moved = (gaussians.means - before).abs()
    assert not moved[1000:].any()
    assert moved[:1000, 0].mean() > 1e5 * moved[:1000, 1].mean() > 0


def test_mcmc_regularisers_are_gradients_of_the_mean_opacity_and_scale() -> None:
    gaussians = ball(5, 0)
    logits = gaussians.opacity_logits.clone().requires_grad_()
    scales = gaussians.log_scales.clone().requires_grad_()
    (0.1 * torch.sigmoid(logits).mean() + 0.2 * scales.exp().mean()).backward()
    gradients = SimpleNamespace(opacity_logits=torch.zeros(5), log_scales=torch.zeros(5, 3))
    mcmc(opacity_loss_weight=0.1, scale_loss_weight=0.2).before_step(gaussians, None, gradients)  # type: ignore[arg-type]
    assert torch.allclose(gradients.opacity_logits, logits.grad)
    assert torch.allclose(gradients.log_scales, scales.grad)


@pytest.mark.parametrize("scale", [2.0**-13, 2.0**13])
@pytest.mark.parametrize("config", [Gradient(), Mcmc(), Original()])
def test_density_control_does_not_depend_on_the_unit(
    config: Gradient | Mcmc | Original, scale: float
) -> None:
    """The same Gaussians are cloned, split and moved, with the same losses, in another unit."""
    found = []
    for unit in (1.0, scale):
        gaussians, adam = marked(200)
        gaussians.means *= unit
        gaussians.log_scales += math.log(unit)
        gaussians.opacity_logits[:60] = -6.0
        gradient = GradientExperiments(prune_scale=0.17)
        options = TrainOptions(density=config, experiments=TrainExperiments(gradient=gradient))
        density = make_strategy(options, steps=STEPS, scale=1.5 * unit, extent=9.0 * unit)
        density.start(200)
        costs = SimpleNamespace(opacity_logits=torch.zeros(200), log_scales=torch.zeros(200, 3))
        if isinstance(density, McmcDensity):
            density.before_step(gaussians, None, costs)  # type: ignore[arg-type]
        else:
            density.observed.gradient_sum += torch.linspace(0, 4e-4, 200)
            density.observed.seen += 1
        step = replace(step_of(density, gaussians, adam, budget=300), noise_rate=1e-2)
        update = density.after_step(step)
        assert update.refinement is not None
        result, changes = update.geometry, update.refinement.changes
        log_scales = result.log_scales - math.log(unit)
        found.append((changes, costs.log_scales, result.means / unit, log_scales))
    assert found[0][0] == found[1][0]
    for ours, other in zip(found[0][1:], found[1][1:], strict=True):
        assert torch.allclose(ours, other, rtol=1e-4, atol=1e-5)


def test_gradients_are_measured_in_normalised_device_coordinates() -> None:
    """A pixel is 2 / width: thresholds are independent of the size of the image."""
    density = strategy(2)
    means2d = torch.tensor([[3e-6, 0.0], [0.0, 4e-6]])
    gradients = SimpleNamespace(means2d=means2d)
    rendered = SimpleNamespace(radii=torch.ones(2), alpha=torch.zeros(100, 200))
    for backend in map(make_backend, ("cpu", "reference")):
        density.start(2)
        backend.observe_gradients(rendered, gradients, *density.statistics, 1)  # type: ignore[arg-type,misc]
        assert torch.allclose(density.observed.gradient_sum, torch.tensor([3e-4, 2e-4]))
        assert density.observed.seen.tolist() == [1.0, 1.0]


def test_the_published_strategy_prunes_after_it_densifies() -> None:
    """A large Gaussian with a large gradient is split, and its halves are pruned if still large; a
    small one is cloned; a transparent one is removed."""
    gaussians, adam = marked(4)
    gaussians.log_scales[:] = torch.log(torch.tensor([0.009, 0.02, 0.9, 0.02]))[:, None]
    gaussians.opacity_logits[:] = torch.tensor([2.0, 2.0, 2.0, -9.0])
    density = OriginalDensity(steps=30_000, extent=1.0)
    density.start(4)
    density.observed.seen += 1
    density.observed.gradient_sum = torch.tensor([3e-4, 3e-4, 3e-4, 0.0])
    rng = np.random.Generator(np.random.PCG64(0))
    step = replace(inputs(gaussians, adam, rng, range(9000, 9001)), budget=100)
    refinement = density.refine(step)
    result, changes = copied(refinement, step, gaussians, adam), refinement.changes
    assert (changes.cloned, changes.split, changes.pruned) == (1, 2, 3)
    scales = result.log_scales.exp()[:, 0]
    assert torch.allclose(scales, torch.tensor([0.009, 0.009, 0.0125, 0.0125]))
    assert len(density.observed.gradient_sum) == len(adam.first["means"]) == 4


@given(
    st.lists(
        st.tuples(st.sampled_from([-1e9, -1.0, -0.0, 0.0, 0.5, 7.0, math.inf]), st.booleans())
    ),
    st.integers(-1, 12),
)
def test_the_highest_scores_are_the_first_of_a_stable_sort(
    rows: list[tuple[float, bool]], count: int
) -> None:
    score = torch.tensor([score for score, _ in rows], dtype=torch.float32)
    among = torch.tensor([candidate for _, candidate in rows], dtype=torch.bool)
    ranked = sorted(torch.nonzero(among)[:, 0].tolist(), key=lambda row: -score[row].item())
    expected = sorted(ranked[: max(0, count)])
    assert torch.nonzero(highest(score, among, count))[:, 0].tolist() == expected
