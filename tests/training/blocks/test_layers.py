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
from pipeline.training.blocks.shares import IMAGE_FACTOR
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


def test_weights_of_a_cropped_view_are_cropped_weights(divided: DividedScene) -> None:
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    layers = BlockLayers(divided.gaussians, divided.partition, 1, WHITE, options, make_backend())
    for view in divided.views:
        # As large as the view needs for the same reduced size.
        whole, part = layers(view).weight, layers(view.cropped(16, 0, 128, 128)).weight
        # Without the pixels at the border, beyond which only the whole view has others.
        inner = slice(None), slice(IMAGE_FACTOR, -IMAGE_FACTOR)
        torch.testing.assert_close(whole[:, 16:144][inner], part[inner])


def test_blocks_correct_each_error_once(divided: DividedScene) -> None:
    """Two blocks that corrected the same error of a pixel would correct it twice."""
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    first, second = (
        BlockLayers(divided.gaussians, divided.partition, number, WHITE, options, make_backend())
        for number in (1, 2)
    )
    for view in divided.views:
        layers = first(view), second(view)
        weights = [each.weight for each in layers]
        assert min(float(weight.max()) for weight in weights) > 0.9
        total = weights[0] + weights[1]
        assert total.min() >= 0 and total.max() < 1 + 1e-5
        # Also of the pixels at the face, where both blocks are.
        seen = torch.maximum(*(each.surroundings.alpha for each in layers)) > 200
        assert total[seen].mean() > 0.95


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
