"""Steps in the memory of a device do what the backend's operators do, one after another."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from pipeline.render import (
    AlphaChangeLoss,
    Backend,
    CameraGradients,
    RasterOptions,
    Surroundings,
    make_backend,
)
from pipeline.render.gpu.counts import Counts
from pipeline.render.resident import Optimised, Planes, ResidentImage, ResidentStep
from pipeline.runtime.errors import UserError
from pipeline.splats.gaussians import Gaussians
from pipeline.training.appearance.embedding import appearance_gradients, colour_offsets
from pipeline.training.optimisers.adam import Adam, AdamOptions, AdamStep, Rates
from tests.render.scenes import camera, random_scene, relative
from tests.tools import need_gpu

HEIGHT, WIDTH = 37, 50
CAMERA = camera(WIDTH, HEIGHT, rotated=True)
RATES = Rates(means=0.01, log_scales=0.02, quats=0.01, opacity_logits=0.03, sh0=0.01, shN=0.002)
EPSILON = 1e-7 * 3 * HEIGHT * WIDTH
ALPHA_LOSS = AlphaChangeLoss(0.5, 0.1, 0.2)


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def pixels(*shape: int, seed: int = 0) -> torch.Tensor:
    return (255 * uniform(*shape, seed=seed)).byte()


def constant_losses(planes: Planes) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Losses that are linear in alpha and depth, and depend on both."""
    return 1e-3 * planes.depth, 1e-3 * planes.alpha


IMAGE = ResidentImage((0, 1), pixels(HEIGHT, WIDTH, 3), None, (1.0, 1.0, 1.0), None)
STEP = ResidentStep(
    camera=CAMERA,
    options=RasterOptions(background=(0.1, 0.7, 0.2)),
    image=IMAGE,
    ssim_weight=0.2,
    l2_weight=0.5,
    camera_gradients=False,
    embedding=None,
    alpha_loss=ALPHA_LOSS,
    losses=None,
    adam={},
)
MASKED = replace(IMAGE, key=None, mask=uniform(HEIGHT, WIDTH, seed=1) > 0.6)
FLOATS = replace(IMAGE, target=uniform(HEIGHT, WIDTH, 3, seed=2), gain=(1.2, 0.9, 0.7))
AROUND = Surroundings(
    behind=pixels(HEIGHT, WIDTH, 3, seed=3),
    alpha=pixels(HEIGHT, WIDTH, seed=4),
    front=pixels(HEIGHT, WIDTH, 3, seed=5) // 2,
    transmittance=pixels(HEIGHT, WIDTH, seed=6),
    correction=(pixels(HEIGHT, WIDTH, 3, seed=7) // 8).to(torch.int8) - 16,
)
STEPS = {
    "plain": STEP,
    "world's axes": STEP,
    "masked": replace(STEP, image=MASKED),
    "gains": replace(STEP, image=FLOATS),
    "cameras": replace(STEP, camera_gradients=True),
    "other losses": replace(STEP, losses=constant_losses),
    "a block": replace(STEP, image=replace(MASKED, surroundings=AROUND), losses=constant_losses),
    "an appearance": replace(STEP, embedding=(0.7, -1.2)),
    "antialiased": replace(STEP, options=RasterOptions(antialias=True)),
    "all that read gradients": replace(STEP, camera_gradients=True, embedding=(0.7, -1.2)),
}
WORLDS_AXES = ("world's axes", "all that read gradients")


class State:
    """Gaussians with Adam's moments and the statistics of density control."""

    def __init__(self, embedding: tuple[float, ...] | None = None, own_frames: bool = True):
        appearance = None if embedding is None else uniform(400, len(embedding), 3, seed=8) - 0.5
        self.gaussians = Gaussians(*random_scene(3, 400, size=0.12), appearance=appearance)
        self.adam = Adam(self.gaussians, AdamOptions(0.9, own_frames, EPSILON), make_backend("gpu"))
        self.gradient_sum, self.seen = torch.zeros(400), torch.zeros(400)

    @property
    def optimised(self) -> Optimised:
        adam, statistics = self.adam, (self.gradient_sum, self.seen)
        return Optimised(self.gaussians.tensors(), adam.first, adam.second, adam.last, *statistics)

    def tensors(self) -> dict[str, torch.Tensor]:
        found = {}
        for name, value in vars(self.optimised).items():
            each = value if isinstance(value, dict) else {"": value}
            found |= {f"{name} {key}": tensor for key, tensor in each.items()}
        return found


def adam_step(number: int) -> AdamStep:
    return AdamStep(number, RATES, HEIGHT * WIDTH)


@dataclass(frozen=True)
class DrawnPlanes:
    alpha: torch.Tensor
    depth: torch.Tensor


def by_operators(
    backend: Backend, state: State, step: ResidentStep, number: int
) -> tuple[float, CameraGradients | None, np.ndarray | None]:
    """Make the step by the operators; return its loss and other gradients."""
    gaussians, adam, image = state.gaussians, state.adam, step.image
    constant, own = gaussians.sh[:, 0], gaussians.sh[:, 0].clone()
    if gaussians.appearance is not None:
        constant += colour_offsets(gaussians.appearance, np.array(step.embedding))
    shown = constant.clone()
    drawn = backend.forward(*gaussians.parameters(), step.camera, step.options)
    color, around, gain = drawn.color, image.surroundings, torch.tensor(image.gain)
    if around is not None:
        color = backend.compose(around, color, drawn.alpha)
    loss = backend.l1_ssim(color * gain, image.target, step.ssim_weight, image.mask, step.l2_weight)
    d_color, d_alpha, d_depth = loss.grad * gain, torch.zeros_like(drawn.alpha), None
    if around is not None:
        d_color, d_alpha = backend.compose_backward(around, drawn.alpha, d_color, step.alpha_loss)
    if step.losses is not None:
        by_alpha, d_depth = step.losses(DrawnPlanes(drawn.alpha, drawn.depth))
        assert by_alpha is not None
        d_alpha = d_alpha + by_alpha
    g = backend.backward(
        drawn, d_color, d_alpha, d_depth, colors=True, camera=step.camera_gradients,
        sh_adam=adam.harmonics(adam_step(number)),
    )  # fmt: skip
    d_embedding = None
    if gaussians.appearance is not None:
        constant[:] = own + (constant - shown)
        assert g.colors is not None
        d_embedding, d_appearance = appearance_gradients(
            gaussians.appearance, np.array(step.embedding), g.colors
        )
        rates = adam.rates(adam_step(number))["appearance"]
        moments = adam.moments("appearance")
        backend.adam_step(gaussians.appearance, d_appearance, moments, rates)
    change = g.means2d
    state.gradient_sum.add_(torch.hypot(change[:, 0] * WIDTH / 2, change[:, 1] * HEIGHT / 2))
    state.seen.add_(drawn.radii > 0)
    adam.step(gaussians, g, adam_step(number), 1)
    return loss.loss, g.camera, d_embedding


@pytest.mark.parametrize("name", STEPS)
def test_resident_steps_equal_the_operators(name: str) -> None:
    """To the last bit, but for what the operators leave to the CPU: sums of losses and of cameras,
    norms of gradients, and colours in a photograph."""
    need_gpu()
    backend, step = make_backend("gpu"), STEPS[name]
    training = backend.resident()
    assert training is not None
    ours, theirs, untouched = (State(step.embedding, name not in WORLDS_AXES) for _ in range(3))
    training.load(ours.optimised)
    for number in (1, 2, 5):
        training.step(replace(step, adam=ours.adam.rates(adam_step(number))))
        (found,) = training.results()
        loss, cameras, d_embedding = by_operators(backend, theirs, step, number)
        assert found.loss == pytest.approx(loss, rel=1e-5)
        assert (found.camera is None) == (cameras is None)
        if found.camera is not None and cameras is not None:
            for part, expected in vars(cameras).items():
                torch.testing.assert_close(getattr(found.camera, part), expected)
        assert (found.embedding is None) == (d_embedding is None)
        if d_embedding is not None:
            np.testing.assert_allclose(found.embedding, d_embedding, rtol=1e-4)
    for key, tensor in ours.tensors().items():
        assert torch.equal(tensor, untouched.tensors()[key]), f"{key} changed before store"
    training.store(ours.optimised)
    for key, tensor in ours.tensors().items():
        if key == "gradient_sum " or step.embedding is not None:
            assert relative(tensor, theirs.tensors()[key]) < 1e-5, key
        else:
            assert torch.equal(tensor, theirs.tensors()[key]), key
    assert (ours.seen == 3).any() and (ours.adam.last == 5).any()
    assert not torch.equal(ours.gaussians.means, untouched.gaussians.means)


VIEWS = [CAMERA, camera(WIDTH, HEIGHT), camera(2 * WIDTH, 3 * HEIGHT)]
ROOMS = {"ample": (1 << 16, 8), "for one": (1, 0), "for some": (700, 0)}


@pytest.mark.parametrize("interval", [1, 5, 50])
def test_results_do_not_depend_on_the_room_for_pairs(
    monkeypatch: pytest.MonkeyPatch, interval: int
) -> None:
    """Steps with more pairs than their arrays hold change nothing and are made again, with those
    that were started after them: the same bits of parameters, moments, statistics and results."""
    need_gpu()
    from pipeline.render.gpu import resident

    found, dispatches = {}, {}
    for name, (least, of_gaussian) in ROOMS.items():
        monkeypatch.setattr(resident, "MIN_CAPACITY", least)
        monkeypatch.setattr(resident, "PAIRS_PER_GAUSSIAN", of_gaussian)
        training, state, results = make_backend("gpu").resident(), State((0.7, -1.2)), []
        assert isinstance(training, resident.GpuTraining)
        training.gpu.counts = Counts()
        training.load(state.optimised)
        for number in range(1, 8):
            view = VIEWS[number // 3]
            size = view.height, view.width
            step = replace(
                STEP,
                camera=view,
                image=replace(IMAGE, key=size, target=pixels(*size, 3, seed=number // 3)),
                embedding=(0.7, -1.2),
                camera_gradients=number % 2 == 0,
                losses=constant_losses if number == 5 else None,
                adam=state.adam.rates(adam_step(number)),
            )
            training.step(step)
            if number % interval == 0:
                results += training.results()
        training.store(state.optimised)
        results += training.results()
        assert len(results) == 7
        found[name] = results, state.tensors()
        dispatches[name] = training.gpu.counts.dispatches
    assert dispatches["for one"] > dispatches["ample"] < dispatches["for some"], "steps repeated"
    results, tensors = found.pop("ample")
    for name, (other, changed) in found.items():
        for one, two in zip(results, other, strict=True):
            assert replace(one, camera=None) == replace(two, camera=None), name
            if one.camera is not None:
                for part, value in vars(one.camera).items():
                    assert torch.equal(value, getattr(two.camera, part)), f"{name}: {part}"
        for key, tensor in tensors.items():
            assert torch.equal(tensor, changed[key]), f"{name}: {key}"


def test_room_is_no_larger_than_the_buffers_of_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """The room that a scene may need at most would exceed them; the pairs that it has fit."""
    need_gpu()
    training, state = make_backend("gpu").resident(), State()
    assert training is not None
    monkeypatch.setattr(training.gpu, "max_bytes", 300_000)
    training.load(state.optimised)
    training.step(replace(STEP, adam=state.adam.rates(adam_step(1))))
    assert training.results()[0].num_visible > 100
    with pytest.raises(UserError, match=r"image: .* holds 0 MB"):
        target = pixels(90, 320, 3)
        image = replace(IMAGE, key=None, target=target)
        step = replace(STEP, image=image, camera=camera(320, 90))
        training.step(replace(step, adam=state.adam.rates(adam_step(2))))


def test_images_beyond_the_cache_are_copied_again(monkeypatch: pytest.MonkeyPatch) -> None:
    need_gpu()
    from pipeline.render.gpu import resident

    monkeypatch.setattr(resident, "IMAGE_CACHE", 3 * HEIGHT * WIDTH + 10)
    results = []
    for cached in (True, False):
        training = make_backend("gpu").resident()
        assert training is not None
        state = State()
        training.load(state.optimised)
        for number in range(1, 6):
            index = number % 2
            target = pixels(HEIGHT, WIDTH, 3, seed=index)
            image = replace(IMAGE, key=(index, 1) if cached else None, target=target)
            adam = state.adam.rates(adam_step(number))
            training.step(replace(STEP, image=image, adam=adam))
        training.store(state.optimised)
        results.append(state.tensors())
    for key, tensor in results[0].items():
        assert torch.equal(tensor, results[1][key]), key


def test_the_backend_of_the_processor_has_no_other_memory() -> None:
    assert make_backend("cpu").resident() is None
