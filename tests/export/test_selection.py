"""The exported Gaussians are those of the region, merged to a number; the cost is said."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.command.main import main
from pipeline.export.selection import (
    contributions_to,
    in_box,
    psnr_against_all,
    select_gaussians,
    subject_box,
)
from pipeline.io.colmap import write_model
from pipeline.io.ply import write_splat_ply
from pipeline.io.splat_files import read_gaussians
from pipeline.metrics.image import PSNR_CAP
from pipeline.render import RasterOptions
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays, GaussianRows, collect
from pipeline.splats.gaussians import Gaussians
from tests.reporting.made import gaussians, ring
from tests.test_command_line import cameras

VIEWS = ring(6, width=60, height=45)
OPTIONS = RasterOptions(near=0.03)
AROUND = (-9.0, -9.0, -9.0, 9.0, 9.0, 9.0)


def scene(*far: tuple[float, float, float]) -> GaussianArrays:
    """What the cameras look at, followed by Gaussians at other places."""
    near = gaussians(300)
    near = dataclasses.replace(near, means=near.means.clip(-1, 1))
    others = dataclasses.replace(
        gaussians(len(far), seed=1), means=np.array(far, np.float32).reshape(-1, 3)
    )
    both = {n: np.concatenate([a, others.arrays()[n]]) for n, a in near.arrays().items()}
    return GaussianArrays(**both)


def outwards(view: View) -> View:
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    return dataclasses.replace(view, world_to_camera=turn @ view.world_to_camera)


def same(found: GaussianArrays, expected: GaussianArrays) -> None:
    for name, values in expected.arrays().items():
        np.testing.assert_array_equal(found.arrays()[name], values)


def first(everything: GaussianArrays, count: int) -> GaussianArrays:
    return GaussianArrays(**{n: values[:count] for n, values in everything.arrays().items()})


def test_what_no_view_shows_is_left_out_first_and_costs_nothing() -> None:
    """Above the cameras, where no image reaches."""
    far = [(x, 0.0, 60.0) for x in np.linspace(-1, 1, 40)]
    everything = scene(*far)
    found = select_gaussians(everything, 300, None, VIEWS, OPTIONS)
    same(found.gaussians, first(everything, 300))
    assert found.psnr == PSNR_CAP
    assert "300 Gaussians of 340: 40 that no training view shows left out" in found.decisions[0]


def test_gaussians_are_merged_so_that_the_views_look_as_before() -> None:
    """Better than without those that show least."""
    everything = scene()
    # Neighbours: twins beside half of them.
    for name, values in everything.arrays().items():
        values[1::2] = values[::2] + (np.float32(0.002) if name == "means" else 0)
    found = select_gaussians(everything, 150, None, VIEWS, OPTIONS)
    weights = contributions_to(everything, VIEWS, OPTIONS)
    assert len(found.gaussians) == 150
    assert "150 merged into neighbours" in found.decisions[0]
    most = np.sort(np.argsort(-weights, kind="stable")[:150])
    pruned = collect(GaussianRows(everything, most, everything.sh_degree))
    cost = psnr_against_all(everything, pruned, VIEWS, OPTIONS)
    assert found.psnr > cost + 5
    others = select_gaussians(everything, 200, None, VIEWS, OPTIONS)
    assert found.psnr < others.psnr < PSNR_CAP
    assert f"PSNR {found.psnr:.2f} dB" in found.decisions[-1]
    # Test views do not choose.
    training = [view for view in VIEWS if not view.is_test]
    np.testing.assert_array_equal(weights, contributions_to(everything, training, OPTIONS))


def test_the_choice_has_the_same_bits_at_any_number_of_threads() -> None:
    one, two = (
        select_gaussians(
            scene(), 100, "subject", VIEWS, dataclasses.replace(OPTIONS, threads=threads)
        )
        for threads in (1, 2)
    )
    same(one.gaussians, two.gaussians)
    assert (one.psnr, one.decisions) == (two.psnr, two.decisions)


def test_the_cost_of_a_region_is_that_of_its_pixels() -> None:
    """A wall behind the region is left out: pixels that show it do not count."""
    wall = [(-8.0, y, z) for y in np.linspace(-6, 6, 30) for z in np.linspace(-4, 4, 20)]
    everything = scene(*wall)
    everything.log_scales[300:], everything.opacity_logits[300:] = -1.0, 3.0
    everything.sh[300:, 0] = 1.5
    everything.log_scales[:300], everything.opacity_logits[:300] = -1.5, 6.0
    found = select_gaussians(everything, None, (-2, -2, -2, 2, 2, 2), VIEWS, OPTIONS)
    same(found.gaussians, first(everything, 300))
    assert "where they show the region" in found.decisions[-1]
    everywhere = psnr_against_all(everything, found.gaussians, VIEWS, OPTIONS)
    assert found.psnr > everywhere + 5


def test_the_subject_is_what_most_cameras_have_in_their_images() -> None:
    far = [(20.0, 0.0, 0.0), (-20.0, 5.0, 0.0), (0.0, 0.0, 30.0)]
    box = subject_box(scene(*far), VIEWS)
    assert -1.01 <= min(box[:3]) < -0.9 and 0.9 < max(box[3:]) <= 1.01
    found = select_gaussians(scene(*far), None, "subject", VIEWS, OPTIONS)
    assert 250 < len(found.gaussians) <= 300
    assert (np.abs(found.gaussians.means) <= 1).all()


def test_cameras_without_a_common_subject_are_one_clear_error() -> None:
    """They stand together and look outwards."""
    views = [outwards(view) for view in VIEWS]
    far = [(x, y, 0.0) for x in np.linspace(-60, 60, 40) for y in np.linspace(-60, 60, 40)]
    everything = scene(*far)
    with pytest.raises(UserError, match=r"common subject.*\n.*give the region as a box"):
        select_gaussians(everything, None, "subject", views, OPTIONS)


def test_an_empty_region_is_one_clear_error() -> None:
    with pytest.raises(UserError, match=r"found none in \[50.*; most Gaussians are at x -"):
        select_gaussians(scene(), None, (50, 50, 50, 51, 51, 51), VIEWS, OPTIONS)
    damaged = scene()
    damaged.means[:] = np.nan
    with pytest.raises(UserError, match="found none in"):
        select_gaussians(damaged, None, AROUND, VIEWS, OPTIONS)


def test_invented_gaussians_stay_and_count() -> None:
    far = [(x, 0.0, 60.0) for x in np.linspace(-1, 1, 40)]
    everything = scene(*far)
    found = select_gaussians(everything, 100, None, VIEWS, OPTIONS, num_invented=40)
    assert found.num_invented == 40 and len(found.gaussians) == 100
    np.testing.assert_array_equal(found.gaussians.means[60:], everything.means[300:])
    with pytest.raises(UserError, match="more than the 40 invented Gaussians, found 40"):
        select_gaussians(scene(*far), 40, None, VIEWS, OPTIONS, num_invented=40)


def test_a_limit_above_the_number_and_a_box_around_everything_choose_all() -> None:
    found = select_gaussians(scene(), 1000, AROUND, VIEWS, OPTIONS)
    same(found.gaussians, scene())
    assert found.psnr is None


@settings(deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-5, 5, width=32)] * 3), min_size=1, max_size=20),
    st.tuples(*[st.floats(-5, 4)] * 3),
    st.tuples(*[st.floats(0.1, 5)] * 3),
)
def test_a_box_holds_what_lies_between_its_corners(points, low, size) -> None:
    high = [a + b for a, b in zip(low, size, strict=True)]
    found = in_box(np.array(points, np.float32), (*low, *high))
    expected = [
        all(a <= x <= b for a, x, b in zip(low, point, high, strict=True)) for point in points
    ]
    assert found.tolist() == expected


# --- splatmake convert ----------------------------------------------------------------------------


@pytest.fixture
def model(tmp_path: Path) -> Path:
    file = tmp_path / "model.ply"
    write_splat_ply(file, Gaussians.from_arrays(scene()))
    write_model(tmp_path / "cameras" / "sparse" / "0", cameras())
    return file


def convert(model: Path, *words: str | Path) -> int:
    target = model.with_name("out.ply")
    return main([str(word) for word in ("convert", model, target, *words)])


def test_a_file_is_pruned_by_the_views_of_cameras_and_cropped(model, capsys) -> None:
    seen = ("--cameras", model.parent / "cameras")
    assert convert(model, "--max-gaussians", "120", *seen) == 0
    assert len(read_gaussians(model.with_name("out.ply"), [])) == 120
    assert "120 Gaussians of 300: " in (shown := capsys.readouterr().out)
    assert " dB against renders of the whole scene" in shown
    assert convert(model, "--box", "-1", "-1", "-1", "0", "1", "1") == 0
    means = read_gaussians(model.with_name("out.ply"), []).means.numpy()
    assert 50 < len(means) < 250 and means[:, 0].max() <= 0
    assert convert(model, "--subject", *seen) == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--max-gaussians", "10"], "--max-gaussians: expected --cameras"),
        (["--max-gaussians", "0"], "expected a positive whole number"),
        (["--subject"], "--subject: expected --cameras"),
        (["--box", "1", "1", "1", "0", "0", "0"], "x0 < x1, y0 < y1, z0 < z1, found [1.0"),
        (["--box", "nan", "0", "0", "1", "1", "1"], "--box: Input should be"),
        (["--box", "7", "7", "7", "8", "8", "8"], "expected a box with Gaussians, found none"),
        (["--box", "1", "1"], "expected 6 arguments"),
    ],
)
def test_a_wrong_choice_is_one_clear_error(model, capsys, words, message) -> None:
    assert convert(model, *words) == EXIT_USER_ERROR
    shown = capsys.readouterr().err
    assert message in shown and "Traceback" not in shown and "what to do" in shown
    assert not model.with_name("out.ply").exists()
