"""Steps in the memory of a device do what the backend's operators do, one after another."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from pipeline.render import (
    AdamRates,
    AlphaChangeLoss,
    Backend,
    CameraGradients,
    FrameMoments,
    Moments,
    RasterOptions,
    ShAdam,
    Surroundings,
    make_backend,
)
from pipeline.render.resident import Optimised, Planes, ResidentImage, ResidentStep
from pipeline.training.appearance.embedding import appearance_gradients, colour_offsets
from tests.render.scenes import NAMES, camera, random_scene, relative
from tests.tools import need_gpu

HEIGHT, WIDTH = 37, 50
CAMERA = camera(WIDTH, HEIGHT, rotated=True)


def rates(*lr: float, eps: float = 1e-7) -> AdamRates:
    return AdamRates(lr if len(lr) > 1 else lr[0], 1, eps=eps)


ADAM = {
    "log_scales": rates(0.02), "opacity_logits": rates(0.03), "sh": rates(0.01, 0.002),
    "appearance": rates(0.01),
}  # fmt: skip
FRAMES = ADAM | {"frames": rates(0.01, 0.01)}
WORLD = ADAM | {"means": rates(0.01, eps=1e-9), "quats": rates(0.01)}
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
    adam=FRAMES,
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
    "world's axes": replace(STEP, adam=WORLD),
    "masked": replace(STEP, image=MASKED),
    "gains": replace(STEP, image=FLOATS),
    "cameras": replace(STEP, camera_gradients=True),
    "other losses": replace(STEP, losses=constant_losses),
    "a block": replace(STEP, image=replace(MASKED, surroundings=AROUND), losses=constant_losses),
    "an appearance": replace(STEP, embedding=(0.7, -1.2)),
    "antialiased": replace(STEP, options=RasterOptions(antialias=True)),
}


def at_step(step: ResidentStep, number: int) -> ResidentStep:
    adam = {name: replace(rates, step=number) for name, rates in step.adam.items()}
    return replace(step, adam=adam)


def start(frames: bool, embedding: tuple[float, ...] | None = None) -> Optimised:
    parameters = dict(zip(NAMES, random_scene(3, 400, size=0.12), strict=True))
    if embedding is not None:
        parameters["appearance"] = uniform(400, len(embedding), 3, seed=8) - 0.5
    first = {name: torch.zeros_like(tensor) for name, tensor in parameters.items()}
    second = {name: torch.zeros_like(tensor) for name, tensor in parameters.items()}
    if frames:
        first["quats"], second["quats"] = torch.zeros(400, 3), torch.zeros(400, 3)
    else:
        second["means"], second["quats"] = torch.zeros(400, 1), torch.zeros(400, 1)
    last = torch.zeros(400, dtype=torch.int32)
    return Optimised(parameters, first, second, last, torch.zeros(400), torch.zeros(400))


@dataclass(frozen=True)
class DrawnPlanes:
    alpha: torch.Tensor
    depth: torch.Tensor


def by_operators(
    backend: Backend, state: Optimised, step: ResidentStep
) -> tuple[float, CameraGradients | None, np.ndarray | None]:
    """The step, by the operators; returns its loss and other gradients."""
    p, image, adam = state.parameters, step.image, step.adam
    moments = {name: Moments(state.first[name], state.second[name]) for name in p}
    constant, own = p["sh"][:, 0], p["sh"][:, 0].clone()
    if step.embedding is not None:
        constant += colour_offsets(p["appearance"], np.array(step.embedding))
    shown = constant.clone()
    drawn = backend.forward(*(p[name] for name in NAMES), step.camera, step.options)
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
    harmonics = ShAdam(moments["sh"], state.last, adam["sh"])
    g = backend.backward(
        drawn, d_color, d_alpha, d_depth, colors=True, camera=step.camera_gradients,
        sh_adam=harmonics,
    )  # fmt: skip
    d_embedding = None
    if step.embedding is not None:
        constant[:] = own + (constant - shown)
        assert g.colors is not None
        d_embedding, d_appearance = appearance_gradients(
            p["appearance"], np.array(step.embedding), g.colors
        )
        backend.adam_step(p["appearance"], d_appearance, moments["appearance"], adam["appearance"])
    change = g.means2d
    state.gradient_sum.add_(torch.hypot(change[:, 0] * WIDTH / 2, change[:, 1] * HEIGHT / 2))
    state.seen.add_(drawn.radii > 0)
    if "frames" in adam:
        frames = FrameMoments(moments["means"], moments["quats"])
        backend.frame_adam(
            p["means"], p["quats"], p["log_scales"], g.means, g.quats, frames, adam["frames"]
        )
    for name in {"log_scales", "opacity_logits", "means", "quats"} & adam.keys():
        backend.adam_step(p[name], getattr(g, name), moments[name], adam[name])
    return loss.loss, g.camera, d_embedding


def tensors(state: Optimised) -> dict[str, torch.Tensor]:
    found = {f"parameter {name}": tensor for name, tensor in state.parameters.items()}
    found |= {f"first {name}": tensor for name, tensor in state.first.items()}
    found |= {f"second {name}": tensor for name, tensor in state.second.items()}
    return found | {
        "last": state.last, "gradient_sum": state.gradient_sum, "seen": state.seen,
    }  # fmt: skip


@pytest.mark.parametrize("name", STEPS)
def test_resident_steps_equal_the_operators(name: str) -> None:
    """To the last bit, but for what the operators leave to the CPU: sums of losses and of cameras,
    norms of gradients, and colours in a photograph."""
    need_gpu()
    backend, step = make_backend("gpu"), STEPS[name]
    training = backend.resident()
    assert training is not None
    ours, theirs, untouched = (start("frames" in step.adam, step.embedding) for _ in range(3))
    training.load(ours)
    for number in (1, 2, 5):
        each = at_step(step, number)
        found = training.step(each)
        loss, cameras, d_embedding = by_operators(backend, theirs, each)
        assert found.loss == pytest.approx(loss, rel=1e-5)
        assert (found.camera is None) == (cameras is None)
        if found.camera is not None and cameras is not None:
            for part, expected in vars(cameras).items():
                torch.testing.assert_close(getattr(found.camera, part), expected)
        assert (found.embedding is None) == (d_embedding is None)
        if d_embedding is not None:
            np.testing.assert_allclose(found.embedding, d_embedding, rtol=1e-4)
    for key, tensor in tensors(ours).items():
        assert torch.equal(tensor, tensors(untouched)[key]), f"{key} changed before store"
    training.store(ours)
    for key, tensor in tensors(ours).items():
        if key == "gradient_sum" or step.embedding is not None:
            assert relative(tensor, tensors(theirs)[key]) < 1e-5, key
        else:
            assert torch.equal(tensor, tensors(theirs)[key]), key
    assert (ours.seen == 3).any() and (ours.last == 5).any()
    assert not torch.equal(ours.parameters["means"], untouched.parameters["means"])


def test_images_beyond_the_cache_are_copied_again(monkeypatch: pytest.MonkeyPatch) -> None:
    need_gpu()
    from pipeline.render.gpu import resident

    monkeypatch.setattr(resident, "IMAGE_CACHE", 3 * HEIGHT * WIDTH + 10)
    results = []
    for cached in (True, False):
        training = make_backend("gpu").resident()
        assert training is not None
        state = start(True)
        training.load(state)
        for number in range(1, 6):
            index = number % 2
            image = replace(
                IMAGE,
                key=(index, 1) if cached else None,
                target=pixels(HEIGHT, WIDTH, 3, seed=index),
            )
            training.step(at_step(replace(STEP, image=image), number))
        training.store(state)
        results.append(tensors(state))
    for key, tensor in results[0].items():
        assert torch.equal(tensor, results[1][key]), key


def test_the_backend_of_the_processor_has_no_other_memory() -> None:
    assert make_backend("cpu").resident() is None
