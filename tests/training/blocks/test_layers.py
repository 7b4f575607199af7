"""The three layers of a view compose to the image of the whole scene, and their gradients are those
of autograd."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pipeline.render import RasterOptions, make_backend
from pipeline.render.views import raster_camera
from pipeline.scene.exposure import ExposureGains
from pipeline.training.blocks.layers import BlockLayers
from pipeline.training.data.surroundings import (
    ALPHA_LOSS_WEIGHT,
    FADE_TOLERANCE,
    GROWTH_TOLERANCE,
    Surroundings,
)
from tests.training.blocks.conftest import NEAR, DividedScene

WHITE = (1.0, 1.0, 1.0)


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("corrected", [False, True])
def test_layers_compose_to_the_whole_scene(
    divided: DividedScene, number: int, corrected: bool
) -> None:
    backend = make_backend()
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    region = divided.partition.region(number)
    layers = BlockLayers(divided.gaussians, divided.partition, number, WHITE, options, backend)
    own = torch.from_numpy(region.contains(divided.gaussians.means.numpy()))
    block_alone = divided.gaussians.select(own.nonzero()[:, 0])
    for view in divided.views:
        camera = raster_camera(view)
        expected = backend.forward(
            *divided.gaussians.parameters(), camera, replace(options, background=WHITE)
        ).color
        block = backend.forward(*block_alone.parameters(), camera, options)
        found = layers(view)
        around = found.surroundings
        if not corrected:
            around = replace(around, correction=None)
        error = (around.compose(block.color, block.alpha) - expected).abs()
        if corrected:
            # Of 8 bits.
            assert error.max() < 0.6 / 255
            assert (found.coarse / 255 - expected.clamp(0, 1)).abs().max() < 0.6 / 255
        else:
            # Layers are 8-bit. Gaussians across the face are in one layer, and blended in order of
            # their centres in the whole scene.
            assert error.mean() < 0.006
            assert error.quantile(0.9) < 0.01


def random_surroundings(front: bool) -> Surroundings:
    torch.manual_seed(0)
    image = lambda *size: torch.randint(0, 256, size, dtype=torch.uint8)  # noqa: E731
    behind, alpha = image(5, 7, 3), image(5, 7)
    if not front:
        return Surroundings(behind, alpha)
    correction = torch.randint(-127, 128, (5, 7, 3), dtype=torch.int8)
    return Surroundings(behind, alpha, image(5, 7, 3), image(5, 7), correction)


@pytest.mark.parametrize("front", [False, True])
def test_gradients_of_the_composition_are_those_of_autograd(front: bool) -> None:
    around = random_surroundings(front)
    color = torch.rand(5, 7, 3, requires_grad=True)
    alpha = torch.rand(5, 7, requires_grad=True)
    weight = torch.rand(5, 7, 3)
    (around.compose(color, alpha) * weight).sum().backward()
    d_color, d_alpha = around.gradients(weight)
    torch.testing.assert_close(d_color, color.grad)
    torch.testing.assert_close(d_alpha, alpha.grad)


def test_gradient_of_the_loss_on_alpha_is_that_of_autograd() -> None:
    around = random_surroundings(front=False)
    alpha = torch.rand(5, 7, requires_grad=True)
    change = alpha - around.alpha / 255
    beyond = (change - GROWTH_TOLERANCE).clamp(min=0) + (-FADE_TOLERANCE - change).clamp(min=0)
    (ALPHA_LOSS_WEIGHT * beyond.square().mean()).backward()
    torch.testing.assert_close(around.alpha_gradient(alpha.detach()), alpha.grad)


def test_layers_of_a_cropped_view_are_cropped_layers(divided: DividedScene) -> None:
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    layers = BlockLayers(divided.gaussians, divided.partition, 1, WHITE, options, make_backend())
    view = divided.views[1]
    whole, part = layers(view), layers(view.cropped(32, 16, 64, 80))
    cut = whole.coarse[16:96, 32:96].int()
    assert (cut - part.coarse.int()).abs().max() <= 1


def test_pixels_that_train_a_block_are_the_same_in_a_cropped_view(divided: DividedScene) -> None:
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    layers = BlockLayers(divided.gaussians, divided.partition, 1, WHITE, options, make_backend())
    for view in divided.views:
        # As large as the view needs for the same reduced size.
        whole, part = layers(view).used, layers(view.cropped(16, 0, 128, 128)).used
        assert torch.equal(whole[:, 16:144], part)


def test_each_pixel_trains_at_most_one_block(divided: DividedScene) -> None:
    """Two blocks that corrected the same pixel would correct it twice."""
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    first, second = (
        BlockLayers(divided.gaussians, divided.partition, number, WHITE, options, make_backend())
        for number in (1, 2)
    )
    for view in divided.views:
        used, other = first(view), second(view)
        assert used.used.any() and other.used.any()
        assert not (used.used & other.used).any()
        # Both regions have the pixels at the face, and one of them is trained there.
        seen = (used.surroundings.alpha > 200) | (other.surroundings.alpha > 200)
        assert (used.used | other.used)[seen].float().mean() > 0.95


def test_pixels_of_other_blocks_have_the_exposure_of_their_view(divided: DividedScene) -> None:
    """They are compared with renders that are multiplied by the view's gains."""
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    view, backend = divided.views[1], make_backend()
    plain = BlockLayers(divided.gaussians, divided.partition, 1, WHITE, options, backend)
    gains = ExposureGains({view.name: (0.5, 0.25, 0.75)})
    exposed = replace(plain, gains=gains)
    factor = torch.tensor([0.5, 0.25, 0.75])
    difference = exposed(view).coarse - plain(view).coarse * factor
    assert difference.abs().max() <= 1
    torch.testing.assert_close(exposed(view).surroundings.behind, plain(view).surroundings.behind)
