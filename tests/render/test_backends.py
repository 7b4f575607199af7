"""Every backend fulfils the interface and agrees with the float64 reference."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from pipeline.render import (
    AdamRates,
    AlphaChangeLoss,
    Backend,
    Moments,
    RasterOptions,
    Subset,
    Surroundings,
    make_backend,
)
from tests.render.scenes import NAMES, Scene, camera, random_scene, random_surroundings

REFERENCE = make_backend("reference")
CAMERA = camera(31, 22, rotated=True)
OPTIONS = RasterOptions(background=(0.2, 0.5, 0.9))


@pytest.fixture
def scene() -> Scene:
    return random_scene(5, 60, size=0.2)


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_forward_is_project_bin_and_blend(any_backend: Backend, scene: Scene) -> None:
    parts = any_backend.blend(any_backend.bin(any_backend.project(scene, CAMERA, OPTIONS)))
    assert torch.equal(parts.color, any_backend.forward(*scene, CAMERA, OPTIONS).color)


def test_a_subset_has_the_image_of_its_gaussians_alone(any_backend: Backend, scene: Scene) -> None:
    """To the bit, and without the Gaussians that are not visible."""
    scene[0][::3, 2] -= 100.0
    some = torch.arange(len(scene[0])) % 2 == 0
    background = (0.25, 0.5, 0.75)
    visible = torch.zeros(len(some), dtype=torch.bool)

    def subsets(seen: torch.Tensor) -> list[Subset]:
        visible.copy_(seen)
        return [Subset(seen & some), Subset(seen, background)]

    part, every = any_backend.forward_subsets(scene, CAMERA, OPTIONS, subsets)
    assert 0 < visible.sum() <= len(visible) * 2 / 3
    for found, which, behind in ((part, some, None), (every, visible, background)):
        options = replace(OPTIONS, background=behind)
        alone = any_backend.forward(*(tensor[which] for tensor in scene), CAMERA, options)
        assert torch.equal(found.color, alone.color)
        assert torch.equal(found.alpha, alone.alpha)
        assert torch.equal(found.radii[which], alone.radii)
        assert not found.radii[~which].any()
        assert found.num_visible == alone.num_visible


@pytest.mark.parametrize("front", [False, True])
@pytest.mark.parametrize("correction", [False, True])
def test_the_composition_equals_the_reference(
    any_backend: Backend, front: bool, correction: bool
) -> None:
    """The gradients, with that of the loss on alpha, equal the reference's as well."""
    around = random_surroundings(22, 31, front, correction)
    color, alpha, d = torch.rand(22, 31, 3), torch.rand(22, 31), noise(22, 31, 3)
    # Less than the gradients through the image, but not negligible.
    loss = AlphaChangeLoss(weight=50.0, fade=0.1, growth=0.25)
    images, gradients = [], []
    for each in (any_backend, REFERENCE):
        images.append(each.compose(around, color, alpha))
        gradients.append(each.compose_backward(around, alpha, d, loss))
    assert images[0].dtype == torch.float32
    assert torch.allclose(*images, atol=2e-6)
    for found, expected in zip(*gradients, strict=True):
        assert torch.allclose(found, expected, atol=2e-6)
    without = REFERENCE.compose_backward(around, alpha, d, replace(loss, weight=0.0))[1]
    assert (gradients[1][1] - without).abs().max() > 0.01
    with pytest.raises(ValueError, match="behind: expected contiguous"):
        any_backend.compose(replace(around, behind=around.behind[1:]), color, alpha)


def test_the_composition_has_the_same_bits_at_any_number_of_threads(any_backend: Backend) -> None:
    around = random_surroundings(70, 101, front=True, correction=True)
    color, alpha, d = torch.rand(70, 101, 3), torch.rand(70, 101), noise(70, 101, 3)
    loss = AlphaChangeLoss(weight=1.0, fade=0.02, growth=0.25)
    one, three = (
        (
            any_backend.compose(around, color, alpha, threads),
            *any_backend.compose_backward(around, alpha, d, loss, threads),
        )
        for threads in (1, 3)
    )
    assert all(map(torch.equal, one, three))


def test_the_composition_without_front_is_a_background() -> None:
    around = Surroundings(torch.full((2, 3, 3), 255, dtype=torch.uint8), torch.zeros(2, 3).byte())
    image = REFERENCE.compose(around, torch.full((2, 3, 3), 0.25), torch.full((2, 3), 0.75))
    assert torch.equal(image, torch.full((2, 3, 3), 0.5))


@pytest.mark.parametrize(
    ("message", "change"),
    [
        ("means: expected float32", {"means": torch.zeros(60, 3).double()}),
        ("quats", {"quats": torch.zeros(60, 3)}),
        ("sh_degree", {"sh": torch.zeros(60, 9, 3)}),
        ("focal lengths must be positive", {"camera": replace(CAMERA, fx=-1.0)}),
        ("camera", {"camera": replace(CAMERA, width=0)}),
        ("camera", {"camera": replace(CAMERA, cy=math.nan)}),
    ],
)
def test_invalid_input_is_an_error_that_names_it(
    any_backend: Backend, scene: Scene, message: str, change: dict[str, object]
) -> None:
    given = {**dict(zip(NAMES, scene, strict=True)), "camera": CAMERA, "options": OPTIONS}
    with pytest.raises(ValueError, match=message):
        any_backend.forward(**(given | change))  # type: ignore[arg-type]


def test_invalid_gradients_are_errors(any_backend: Backend, scene: Scene) -> None:
    drawn = any_backend.forward(*scene, CAMERA, OPTIONS)
    with pytest.raises(ValueError, match="d_color"):
        any_backend.backward(drawn, torch.zeros(3, 3, 3))
    with pytest.raises(ValueError, match="step 0"):
        p, grad, m, v = (torch.zeros(4, 3) for _ in range(4))
        any_backend.adam_step(p, grad, Moments(m, v), AdamRates(0.1, 0))
    assert set(any_backend.facts()) == {"instruction_set", "compiler"}


def test_an_unknown_backend_is_an_error() -> None:
    with pytest.raises(ValueError, match="no backend 'x'; there are cpu, gpu, reference"):
        make_backend("x")
