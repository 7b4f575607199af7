"""Blocks hold every Gaussian once, have similar cost, and get the views that show them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.io.npz import write_npz
from pipeline.render import RasterOptions
from pipeline.scene.blocks import Partition
from pipeline.splats.arrays import collect
from pipeline.splats.gaussians import concat
from pipeline.training.blocks.train import with_far_field
from pipeline.training.blocks.union import Union
from tests.training.blocks.conftest import NEAR, DividedScene, divide, layers_of, moved
from tests.training.conftest import ball


def owners(partition: Partition, means: np.ndarray) -> np.ndarray:
    numbers = range(1, len(partition.blocks) + 1)
    return np.stack([partition.box(number).contains(means) for number in numbers])


@pytest.mark.parametrize("blocks", [2, 3, 4, 7])
def test_each_gaussian_is_in_exactly_one_block(divided: DividedScene, blocks: int) -> None:
    partition = divide(divided.gaussians, divided.views, blocks)
    assert len(partition.blocks) == blocks
    assert (owners(partition, divided.gaussians.means.numpy()).sum(0) == 1).all()


def test_points_far_outside_of_the_scene_are_in_exactly_one_block(divided: DividedScene) -> None:
    far = np.random.default_rng(3).normal(size=(200, 3)) * 1e6
    assert (owners(divide(divided.gaussians, divided.views, 5), far).sum(0) == 1).all()


def test_blocks_explain_similar_numbers_of_pixels(divided: DividedScene) -> None:
    shares = [sum(v.share for v in block.views) for block in divided.partition.blocks]
    assert max(shares) < 1.6 * min(shares)


def test_windows_hold_the_pixels_in_which_a_block_is_trained(divided: DividedScene) -> None:
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    views = {view.name: view for view in divided.views}
    partition = divided.partition
    for number, block in enumerate(partition.blocks, 1):
        box = partition.region(number)
        layers = layers_of(divided.gaussians, partition, number, options, box)
        assert block.views
        for shown in block.views:
            left, top, width, height = shown.window
            weight = layers(views[shown.name]).weight
            outside = weight.clone()
            outside[top : top + height, left : left + width] = 0
            assert outside.sum() <= 0.01 * weight.sum()


def test_a_view_without_the_block_is_not_among_its_views(divided: DividedScene) -> None:
    """A camera that faces away from both blocks."""
    partition = divided.partition
    away = divided.views[0]
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ away.world_to_camera
    looking_away = type(away)(**{**vars(away), "name": "away", "world_to_camera": turned})
    found = divide(divided.gaussians, [*divided.views, looking_away], 2)
    for block, other in zip(found.blocks, partition.blocks, strict=True):
        assert "away" not in {view.name for view in block.views}
        assert len(block.views) == len(other.views)


def test_a_view_past_the_gaussians_of_a_block_is_an_overview(divided: DividedScene) -> None:
    """It looks through the gap between the two clusters."""
    seen = divided.views[0]
    narrow = replace(seen, name="narrow", fx=20 * seen.fx, fy=20 * seen.fy)
    gaussians = concat([moved(ball(60, 1), -1.8), moved(ball(60, 2), 1.8)])
    found = divide(gaussians, [*divided.views, narrow], 2)
    assert all("narrow" not in {view.name for view in block.views} for block in found.blocks)
    assert any("narrow" in block.overviews for block in found.blocks)


def test_overviews_are_not_trained_on_where_windows_are(divided: DividedScene) -> None:
    options = RasterOptions(sh_degree=1, near=NEAR, threads=1)
    block, view = divided.partition.blocks[0], divided.views[1]
    windows = {shown.name: shown for shown in block.views}
    left, top, width, height = windows[view.name].window
    layers = layers_of(divided.gaussians, divided.partition, 1, options)
    ignored = layers(view).ignored
    assert ignored is not None and ignored.sum() == width * height
    assert ignored[top : top + height, left : left + width].all()
    assert layers(view.cropped(left, top, width, height)).ignored is None
    assert layers(replace(view, name="another")).ignored is None


def test_a_partition_has_the_same_bits_at_any_number_of_threads(divided: DividedScene) -> None:
    one = divide(divided.gaussians, divided.views, 3, threads=1)
    assert one == divide(divided.gaussians, divided.views, 3, threads=2)


def test_a_partition_survives_its_file(divided: DividedScene, tmp_path) -> None:
    divided.partition.write(tmp_path)
    assert Partition.read(tmp_path) == divided.partition


def test_margins_reach_beyond_inner_faces_alone(divided: DividedScene) -> None:
    for block in divided.partition.blocks:
        for bound, margin in zip(
            (*block.lower, *block.upper), (*block.margin_below, *block.margin_above), strict=True
        ):
            assert (margin > 0) == (bound is not None)


def test_the_union_of_regions_is_the_scene(divided: DividedScene, tmp_path: Path) -> None:
    """Each block is trained with its margin, and keeps its box."""
    partition, gaussians = divided.partition, divided.gaussians.with_sh_degree(1)
    kept, files = [], []
    for number in (1, 2):
        region = partition.region(number).contains(gaussians.means.numpy())
        trained = gaussians.select(torch.from_numpy(np.flatnonzero(region)))
        within = partition.box(number).contains(trained.means.numpy())
        kept.append(trained.select(torch.from_numpy(within)))
        files.append(tmp_path / f"{number}.npz")
        # A block of a lower degree has zeros in the bands that it lacks.
        write_npz(files[-1], trained.with_sh_degree(1 if number == 1 else 0))
    kept[1].sh[:, 1:] = 0
    joined = Union(files, partition)
    assert len(joined) == len(gaussians) and joined.sh_degree == 1
    order = lambda means: means[np.lexsort(means.T)]  # noqa: E731
    np.testing.assert_array_equal(order(collect(joined).means), order(gaussians.means.numpy()))
    found, expected = collect(joined).arrays(), concat(kept).arrays()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array)
    write_npz(tmp_path / "union.npz", joined)
    write_npz(tmp_path / "expected.npz", concat(kept))
    assert (tmp_path / "union.npz").read_bytes() == (tmp_path / "expected.npz").read_bytes()


def test_the_far_field_of_a_block_stays_as_it_was(divided: DividedScene) -> None:
    far = moved(ball(9, 3), 50.0)
    scene, partition = concat([divided.gaussians, far]), divided.partition
    trained = divided.gaussians.with_sh_degree(2)
    parts = [with_far_field(trained, scene, partition, number) for number in (1, 2)]
    assert [len(part) - len(trained) for part in parts] == [0, 9]
    torch.testing.assert_close(parts[1].means[-9:], far.means)
    torch.testing.assert_close(parts[1].with_sh_degree(1).sh[-9:], far.sh)
    assert not partition.region(2).contains(far.means.numpy()).any()
