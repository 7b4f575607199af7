"""Holes are filled where no photograph sees, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.coverage.training_views import render_training_views
from pipeline.holes.fill import FilledScene, fill_holes, invented_pixels
from pipeline.holes.fit import without_shown
from pipeline.holes.outputs import write_holes
from pipeline.holes.painters import inpaint
from pipeline.holes.placement import find_holes, hole_depths
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb, render_view
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians, concat
from tests.coverage.scenes import UP, camera, wall

OPTIONS = RasterOptions(sh_degree=0, threads=1)
BLUE = torch.tensor([-1.0, -1.0, 1.5])


def scene() -> Gaussians:
    """A wall of which the photographs see the middle, and a blue sheet far behind it, which they
    never see."""
    seen = wall((-2.5, 2.5), (-1.5, 1.5))
    far = wall((-8, 8), (-8, 8), 1.0)
    means = far.means * torch.tensor([10.0, 10.0, 40.0])
    behind = replace(
        far, means=means, log_scales=far.log_scales + np.log(10.0), sh=BLUE.expand(len(far), 1, 3)
    )
    return concat([seen, replace(behind, sh=behind.sh.contiguous())])


def views() -> list[View]:
    """Photographs of the middle of the wall, and one beside it that is a test view."""
    photographs = [camera(f"{x}.png", (x, 0, 0), focal=90.0) for x in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    return [*photographs, camera("test.png", (2.2, 0, 0), test=True, focal=90.0)]


@pytest.fixture(autouse=True, scope="module")
def few_steps():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.holes.fit.STEPS", 40)
        patch.setattr("pipeline.holes.fill.MAX_PAINTED", 8)
        yield


@pytest.fixture(scope="module")
def filled(few_steps: None) -> FilledScene:
    return fill_holes(scene(), views(), UP, inpaint, OPTIONS)


def test_the_trained_gaussians_come_first_and_do_not_change(filled):
    before = scene()
    assert filled.num_invented > 0 and filled.first_invented == len(before)
    for name, tensor in filled.gaussians.first(len(before)).tensors().items():
        assert torch.equal(tensor, before.tensors()[name])


def test_what_photographs_see_does_not_change(filled):
    for view in views():
        if not view.is_test:
            before, after = (render_rgb(g, view, OPTIONS) for g in (scene(), filled.gaussians))
            assert np.sqrt(((after - before) ** 2).mean()) < 0.01


def test_invented_gaussians_continue_the_wall_beyond_the_photographs(filled):
    """In its colour and about its depth, not in the colour of what is far behind."""
    view = views()[-1]
    invented = invented_pixels(filled, view, OPTIONS)
    assert 0.02 < invented.mean() < 0.9
    before, after = (render_view(g, view, OPTIONS) for g in (scene(), filled.gaussians))
    inside = invented & (before.median_depth > 20)
    assert inside.any()
    assert np.abs(after.rgb[inside] - 0.64).mean() < np.abs(before.rgb[inside] - 0.64).mean() / 2
    depth = after.median_depth[inside]
    assert 3.9 < np.median(depth) < 6


def test_the_bits_do_not_depend_on_the_number_of_threads(filled):
    again = fill_holes(scene(), views(), UP, inpaint, replace(OPTIONS, threads=2))
    for name, tensor in filled.gaussians.tensors().items():
        assert torch.equal(tensor, again.gaussians.tensors()[name]), name


def test_a_wall_without_holes_stays_as_it_is():
    whole = wall((-30, 30), (-30, 30))
    found = fill_holes(whole, views(), UP, inpaint, OPTIONS)
    assert found.num_invented == 0 and found.gaussians is whole


def test_a_gaussian_that_a_photograph_shows_is_left_out():
    """In front of the wall; one behind it stays."""
    both = wall((0, 0.15), (0, 0.05), 4.0)
    both.means[:, 2] = torch.tensor([3.0, 5.0])
    kept = without_shown(scene(), both, views()[:1], OPTIONS)
    assert kept.means[:, 2].tolist() == [5.0]


def test_depths_of_holes_continue_the_surface_behind():
    gaussians = scene()
    training = render_training_views(views(), lambda view: render_view(gaussians, view, OPTIONS))
    assert training is not None
    found = find_holes(views()[-1], gaussians, training, OPTIONS)
    assert found.hole.any() and (found.hole <= found.unseen).all()
    depth = hole_depths(found, training.background_depth)
    np.testing.assert_allclose(depth[found.hole], 4, rtol=0.02)
    np.testing.assert_array_equal(depth[~found.hole], found.probe.depth[~found.hole])


def test_the_record_and_its_pictures(filled, tmp_path):
    record = write_holes(tmp_path, filled, views()[-1:], "inpaint", OPTIONS)
    assert record.painter == "inpaint" and record.num_invented == filled.num_invented
    [view] = record.views
    assert view.name == "test.png" and view.mask is not None
    files = [f for p in record.painted for f in (p.before, p.mask, p.after) if f is not None]
    assert 3 <= len(files) <= 6
    assert all((tmp_path / file).is_file() for file in [*files, view.mask])
    assert record.summary().mean_share == view.invented_share > 0
