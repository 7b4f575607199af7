"""The three layers of a view compose to the image of the whole scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.render import RasterOptions, make_backend
from pipeline.render.views import raster_camera
from pipeline.scene.exposure import ExposureGains, ViewLight
from pipeline.training.blocks.options import FIRST, SECOND, corrected_box
from pipeline.training.blocks.shares import IMAGE_FACTOR
from pipeline.training.run import Part
from tests.training.blocks.conftest import NEAR, WHITE, DividedScene, layers_of


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("corrected", [False, True])
def test_layers_compose_to_the_whole_scene(
    divided: DividedScene, number: int, corrected: bool
) -> None:
    backend = make_backend()
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    region = divided.partition.region(number)
    layers = layers_of(divided.gaussians, divided.partition, number, options)
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
        error = (backend.compose(around, block.color, block.alpha) - expected).abs()
        if corrected:
            # Of 8 bits.
            assert error.max() < 0.6 / 255
            assert (found.coarse / 255 - expected.clamp(0, 1)).abs().max() < 0.6 / 255
        else:
            # Layers are 8-bit. Gaussians across the face are in one layer, and blended in order of
            # their centres in the whole scene.
            assert error.mean() < 0.006
            assert error.quantile(0.9) < 0.01


def test_layers_of_a_cropped_view_are_cropped_layers(divided: DividedScene) -> None:
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    layers = layers_of(divided.gaussians, divided.partition, 1, options)
    view = divided.views[1]
    whole, part = layers(view), layers(view.cropped(32, 16, 64, 80))
    cut = whole.coarse[16:96, 32:96].int()
    assert (cut - part.coarse.int()).abs().max() <= 1


def test_weights_of_a_cropped_view_are_cropped_weights(divided: DividedScene) -> None:
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    layers = layers_of(divided.gaussians, divided.partition, 1, options)
    for view in divided.views:
        # As large as the view needs for the same reduced size.
        whole, part = layers(view).weight, layers(view.cropped(16, 0, 128, 128)).weight
        # Without the pixels at the border, beyond which only the whole view has others.
        inner = slice(None), slice(IMAGE_FACTOR, -IMAGE_FACTOR)
        torch.testing.assert_close(whole[:, 16:144][inner], part[inner])


@pytest.mark.parametrize("part", [FIRST, SECOND])
def test_blocks_correct_each_error_once(divided: DividedScene, part: Part) -> None:
    """Two blocks that corrected the same error of a pixel would correct it twice. What is in the
    regions of both may be corrected twice in the second part, since each keeps a part of it."""
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    partition, gaussians = divided.partition, divided.gaussians
    regions = [partition.region(number).contains(gaussians.means.numpy()) for number in (1, 2)]
    in_both = torch.from_numpy(np.logical_and(*regions))
    assert 0 < in_both.sum() < len(in_both) / 2
    if part == SECOND:
        gaussians = gaussians.select(~in_both)
    layers = [
        layers_of(gaussians, partition, number, options, corrected_box(partition, number, part))
        for number in (1, 2)
    ]
    for view in divided.views:
        first, second = (each(view) for each in layers)
        assert min(float(each.weight.max()) for each in (first, second)) > 0.8
        total = first.weight + second.weight
        assert total.min() >= 0 and total.max() < 1 + 1e-5
        seen = torch.maximum(first.surroundings.alpha, second.surroundings.alpha) > 200
        assert total[seen].mean() > 0.95


def test_at_a_face_both_blocks_correct_in_the_second_part(divided: DividedScene) -> None:
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    partition, gaussians = divided.partition, divided.gaussians
    regions = [partition.region(number).contains(gaussians.means.numpy()) for number in (1, 2)]
    at_face = gaussians.select(torch.from_numpy(np.logical_and(*regions)))
    for number in (1, 2):
        box = corrected_box(partition, number, SECOND)
        layers = layers_of(at_face, partition, number, options, box)(divided.views[0])
        assert layers.weight[layers.surroundings.alpha > 200].min() > 0.99


def test_pixels_of_other_blocks_have_the_exposure_of_their_view(divided: DividedScene) -> None:
    """They are compared with renders that are multiplied by the view's gains."""
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    view = divided.views[1]
    plain = layers_of(divided.gaussians, divided.partition, 1, options)
    gains = ExposureGains({view.name: ViewLight(gain=(0.5, 0.25, 0.75))})
    exposed = replace(plain, gains=gains)
    factor = torch.tensor([0.5, 0.25, 0.75])
    difference = exposed(view).coarse - plain(view).coarse * factor
    assert difference.abs().max() <= 1
    torch.testing.assert_close(exposed(view).surroundings.behind, plain(view).surroundings.behind)
