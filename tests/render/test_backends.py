"""Every backend fulfils the interface and agrees with the float64 reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from pipeline.render import (
    AdamRates,
    AlphaChangeLoss,
    Backend,
    FrameMoments,
    Moments,
    RasterOptions,
    ShAdam,
    Subset,
    Surroundings,
    make_backend,
)
from pipeline.render.registry import BACKENDS
from tests.render.scenes import NAMES, Scene, camera, random_scene, relative
from tests.tools import need_gpu

REFERENCE = make_backend("reference")
CAMERA = camera(31, 22, rotated=True)
OPTIONS = RasterOptions(background=(0.2, 0.5, 0.9))


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> Backend:
    if request.param == "gpu":
        need_gpu()
    return make_backend(request.param)


@pytest.fixture
def scene() -> Scene:
    return random_scene(5, 60, size=0.2)


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_images_and_gradients_equal_the_reference(backend: Backend, scene: Scene) -> None:
    gradients = []
    images = []
    for each in (backend, REFERENCE):
        drawn = each.forward(*scene, CAMERA, OPTIONS)
        images.append((drawn.color, drawn.alpha, drawn.depth, drawn.median_depth, drawn.radii))
        d = noise(22, 31, 3), noise(22, 31, seed=1), noise(22, 31, seed=2)
        gradients.append(each.backward(drawn, *d, colors=True, camera=True))
        assert drawn.num_visible > 0 == drawn.num_dropped
    for found, expected in zip(*images, strict=True):
        assert found.dtype == torch.float32
        assert torch.allclose(found, expected, atol=2e-5)
    found, expected = gradients
    for name in (*NAMES, "means2d", "colors"):
        assert getattr(found, name).dtype == torch.float32
        assert relative(getattr(found, name), getattr(expected, name)) < 1e-5, name
    for name in ("rotation", "translation", "focal", "principal"):
        assert relative(getattr(found.camera, name), getattr(expected.camera, name)) < 1e-5, name


def test_forward_is_project_bin_and_blend(backend: Backend, scene: Scene) -> None:
    parts = backend.blend(backend.bin(backend.project(scene, CAMERA, OPTIONS)))
    assert torch.equal(parts.color, backend.forward(*scene, CAMERA, OPTIONS).color)


def test_a_subset_has_the_image_of_its_gaussians_alone(backend: Backend, scene: Scene) -> None:
    """To the bit, and without the Gaussians that are not visible."""
    scene[0][::3, 2] -= 100.0
    some = torch.arange(len(scene[0])) % 2 == 0
    background = (0.25, 0.5, 0.75)
    visible = torch.zeros(len(some), dtype=torch.bool)

    def subsets(seen: torch.Tensor) -> list[Subset]:
        visible.copy_(seen)
        return [Subset(seen & some), Subset(seen, background)]

    part, every = backend.forward_subsets(scene, CAMERA, OPTIONS, subsets)
    assert 0 < visible.sum() <= len(visible) * 2 / 3
    for found, which, behind in ((part, some, None), (every, visible, background)):
        options = replace(OPTIONS, background=behind)
        alone = backend.forward(*(tensor[which] for tensor in scene), CAMERA, options)
        assert torch.equal(found.color, alone.color)
        assert torch.equal(found.alpha, alone.alpha)
        assert torch.equal(found.radii[which], alone.radii)
        assert not found.radii[~which].any()
        assert found.num_visible == alone.num_visible


@pytest.mark.parametrize("target", [torch.rand(22, 31, 3), torch.full((22, 31, 3), 90).byte()])
def test_the_loss_equals_the_reference(backend: Backend, target: torch.Tensor) -> None:
    rendered, mask = noise(22, 31, 3).sigmoid(), noise(22, 31) > 1
    found, expected = (
        each.l1_ssim(rendered, target, 0.2, mask, 0.5) for each in (backend, REFERENCE)
    )
    assert found.loss == pytest.approx(expected.loss, rel=1e-5)
    assert found.grad.dtype == torch.float32
    assert relative(found.grad, expected.grad) < 1e-5


def random_surroundings(height: int, width: int, front: bool, correction: bool) -> Surroundings:
    torch.manual_seed(0)

    def plane(*channels: int) -> torch.Tensor:
        return torch.randint(0, 256, (height, width, *channels), dtype=torch.uint8)

    signed = torch.randint(-127, 128, (height, width, 3), dtype=torch.int8)
    return Surroundings(
        plane(3),
        plane(),
        plane(3) if front else None,
        plane() if front else None,
        signed if correction else None,
    )


@pytest.mark.parametrize("front", [False, True])
@pytest.mark.parametrize("correction", [False, True])
def test_the_composition_equals_the_reference(
    backend: Backend, front: bool, correction: bool
) -> None:
    """And its gradients, with that of the loss on alpha."""
    around = random_surroundings(22, 31, front, correction)
    color, alpha, d = torch.rand(22, 31, 3), torch.rand(22, 31), noise(22, 31, 3)
    # Less than the gradients through the image, but not negligible.
    loss = AlphaChangeLoss(weight=50.0, fade=0.1, growth=0.25)
    images, gradients = [], []
    for each in (backend, REFERENCE):
        images.append(each.compose(around, color, alpha))
        gradients.append(each.compose_backward(around, alpha, d, loss))
    assert images[0].dtype == torch.float32
    assert torch.allclose(*images, atol=2e-6)
    for found, expected in zip(*gradients, strict=True):
        assert torch.allclose(found, expected, atol=2e-6)
    without = REFERENCE.compose_backward(around, alpha, d, replace(loss, weight=0.0))[1]
    assert (gradients[1][1] - without).abs().max() > 0.01
    with pytest.raises(ValueError, match="behind: expected contiguous"):
        backend.compose(replace(around, behind=around.behind[1:]), color, alpha)


def test_the_composition_has_the_same_bits_at_any_number_of_threads(backend: Backend) -> None:
    around = random_surroundings(70, 101, front=True, correction=True)
    color, alpha, d = torch.rand(70, 101, 3), torch.rand(70, 101), noise(70, 101, 3)
    loss = AlphaChangeLoss(weight=1.0, fade=0.02, growth=0.25)
    one, three = (
        (
            backend.compose(around, color, alpha, threads),
            *backend.compose_backward(around, alpha, d, loss, threads),
        )
        for threads in (1, 3)
    )
    assert all(map(torch.equal, one, three))


def test_the_composition_without_front_is_a_background() -> None:
    around = Surroundings(torch.full((2, 3, 3), 255, dtype=torch.uint8), torch.zeros(2, 3).byte())
    image = REFERENCE.compose(around, torch.full((2, 3, 3), 0.25), torch.full((2, 3), 0.75))
    assert torch.equal(image, torch.full((2, 3, 3), 0.5))


def copies(*tensors: torch.Tensor) -> list[torch.Tensor]:
    return [tensor.clone() for tensor in tensors]


def stepped(step: Callable[..., object], tensors: list[torch.Tensor]) -> list[torch.Tensor]:
    step(*tensors)
    return tensors


def test_optimiser_steps_equal_the_reference(backend: Backend, scene: Scene) -> None:
    n = len(scene[0])
    means, log_scales, quats, _, sh = scene
    moments = [0.1 * noise(n, 3, seed=3), noise(n, 3, seed=4).square()]
    moments += [0.1 * noise(n, 3, seed=5), noise(n, 3, seed=6).square()]
    last = torch.full((n,), 4, dtype=torch.int32)
    d_means, d_quats = noise(n, 3, seed=7), noise(n, 4, seed=8)
    results = []
    for each in (backend, REFERENCE):

        def plain(m: torch.Tensor, a: torch.Tensor, b: torch.Tensor, each=each) -> None:
            each.adam_step(m, d_means, Moments(a, b), AdamRates(0.01, 3))

        def frame(m: torch.Tensor, q: torch.Tensor, *state: torch.Tensor, each=each) -> None:
            moments = FrameMoments(Moments(*state[:2]), Moments(*state[2:]))
            rates = AdamRates((0.02, 0.01), 3)
            each.frame_adam(m, q, log_scales, d_means, d_quats, moments, rates)

        def harmonics(s: torch.Tensor, a: torch.Tensor, b: torch.Tensor, each=each) -> None:
            rates = AdamRates((0.01, 0.002), 6, eps=0.01)
            adam = ShAdam(Moments(a, b), last.clone(), rates)
            drawn = each.forward(*scene[:4], s, CAMERA, OPTIONS)
            gradients = each.backward(drawn, noise(22, 31, 3), sh_adam=adam)
            assert len(gradients.sh) == 0
            assert (adam.last == 6).any() and (adam.last == 4).any()

        results.append(
            stepped(plain, copies(means, *moments[:2]))
            + stepped(frame, copies(means, quats, *moments))
            + stepped(harmonics, copies(sh, 0.01 * noise(*sh.shape), 0.01 * noise(*sh.shape) ** 2))
        )
    for found, expected in zip(*results, strict=True):
        assert torch.allclose(found, expected, rtol=1e-4, atol=2e-6)


def test_invalid_input_is_an_error(backend: Backend, scene: Scene) -> None:
    with pytest.raises(ValueError, match="means: expected float32"):
        backend.forward(scene[0].double(), *scene[1:], CAMERA, OPTIONS)
    with pytest.raises(ValueError, match="focal lengths must be positive"):
        backend.forward(*scene, replace(CAMERA, fx=-1.0), OPTIONS)
    drawn = backend.forward(*scene, CAMERA, OPTIONS)
    with pytest.raises(ValueError, match="d_color"):
        backend.backward(drawn, torch.zeros(3, 3, 3))
    with pytest.raises(ValueError, match="step 0"):
        p, grad, m, v = (torch.zeros(4, 3) for _ in range(4))
        backend.adam_step(p, grad, Moments(m, v), AdamRates(0.1, 0))
    assert set(backend.facts()) == {"instruction_set", "compiler"}


def test_an_unknown_backend_is_an_error() -> None:
    with pytest.raises(ValueError, match="no backend 'x'; there are cpu, gpu, reference"):
        make_backend("x")
