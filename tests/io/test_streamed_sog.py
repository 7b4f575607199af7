"""Streamed SOG: the tree, its leaves and their levels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.io import streamed_sog
from pipeline.io.splat_files import is_antialiased, read_gaussians
from pipeline.io.streamed_sog import LEVELS, LOD_META, write_streamed_sog
from pipeline.splats.reduce import reduce_gaussians
from tests.splats.samples import sample


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    """Leaves of up to 100 Gaussians, files of up to 150: a file has one leaf at level 0, several at
    others."""
    monkeypatch.setattr(streamed_sog, "LEAF", 100)
    monkeypatch.setattr(streamed_sog, "FILE", 150)
    rows = reduce_gaussians(sample(330, 1).as_arrays(), 3, 0.0, True)
    write_streamed_sog(tmp_path / "scene", rows, antialias=True)
    return tmp_path / "scene"


def read_meta(folder: Path) -> dict[str, Any]:
    return json.loads((folder / LOD_META).read_text())


def leaves(node: dict[str, Any]) -> list[dict[str, Any]]:
    if "children" not in node:
        return [node]
    return [leaf for child in node["children"] for leaf in leaves(child)]


def inside(inner: dict[str, Any], outer: dict[str, Any]) -> bool:
    low, high = (np.array(inner["bound"][k]) for k in ("min", "max"))
    return bool((low >= outer["bound"]["min"]).all() and (high <= outer["bound"]["max"]).all())


def test_the_index_names_every_file_and_counts_every_gaussian(folder) -> None:
    meta = read_meta(folder)
    assert meta["version"] == 1 and "environment" not in meta
    assert meta["count"] == sum(meta["counts"]) and meta["counts"][0] == 330
    found = {str(p.relative_to(folder)) for p in folder.rglob("meta.json")}
    assert found == set(meta["filenames"]) and len(found) == len(meta["filenames"])
    seen = leaves(meta["tree"])
    assert len(seen) == 4 and meta["lodLevels"] == len(meta["counts"]) >= LEVELS
    for level in range(meta["lodLevels"]):
        counts = [leaf["lods"][str(level)]["count"] for leaf in seen]
        assert sum(counts) == meta["counts"][level]
        assert level == 0 or max(counts) <= 100 / 2**level + 1


def test_files_hold_neighbouring_leaves_of_one_level_without_gaps(folder) -> None:
    meta = read_meta(folder)
    parts: dict[int, list[tuple[int, int]]] = {}
    for leaf in leaves(meta["tree"]):
        for level, part in leaf["lods"].items():
            assert meta["filenames"][part["file"]].startswith(f"{level}_")
            parts.setdefault(part["file"], []).append((part["offset"], part["count"]))
    assert any(len(found) > 1 for found in parts.values())
    for file, found in parts.items():
        ends = np.cumsum([count for _, count in found])
        assert [offset for offset, _ in found] == [0, *ends[:-1]] and ends[-1] <= 150
        assert len(read_gaussians(folder / meta["filenames"][file], [])) == ends[-1]


def test_the_coarsest_level_is_one_file(folder) -> None:
    """A viewer shows the whole scene after the first file."""
    meta = read_meta(folder)
    last = meta["lodLevels"] - 1
    assert [name for name in meta["filenames"] if name.startswith(f"{last}_")] == [
        f"{last}_0/meta.json"
    ]


@pytest.mark.parametrize("count", [1, 10**5, 2**17, 10**6, 3 * 10**7, 10**9])
def test_scenes_of_any_size_have_levels_until_the_first_picture_is_small(count) -> None:
    levels = streamed_sog.num_levels(count)
    assert levels >= LEVELS and count / 2 ** (levels - 1) <= streamed_sog.FIRST_PICTURE


def test_each_leaf_holds_its_gaussians_in_its_box(folder) -> None:
    meta = read_meta(folder)
    finest = []
    for leaf in leaves(meta["tree"]):
        assert inside(leaf, meta["tree"])
        for level, part in leaf["lods"].items():
            path = folder / meta["filenames"][part["file"]]
            assert is_antialiased(path)
            means = read_gaussians(path, []).means.numpy()
            means = means[part["offset"] : part["offset"] + part["count"]]
            assert (means >= np.array(leaf["bound"]["min"]) - 1e-3).all()
            assert (means <= np.array(leaf["bound"]["max"]) + 1e-3).all()
            if level == "0":
                finest.append(means)
    everything = np.concatenate(finest)
    expected = sample(330, 1).means.numpy()
    nearest = np.abs(expected[:, None] - everything[None]).max(2).min(1)
    assert len(everything) == 330 and nearest.max() < 1e-3


def test_the_first_branches_are_the_blocks(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(streamed_sog, "LEAF", 20)
    rows = reduce_gaussians(sample(90, 0).as_arrays(), 3, 0.0, True)
    blocks = 1 + np.arange(90) % 3
    write_streamed_sog(tmp_path, rows, blocks=blocks)
    children = read_meta(tmp_path)["tree"]["children"]
    counts = [sum(leaf["lods"]["0"]["count"] for leaf in leaves(child)) for child in children]
    assert counts == [30, 30, 30]
    means = rows.source.means[rows.rows]
    for number, child in enumerate(children, 1):
        inner = means[blocks == number]
        assert (inner >= child["bound"]["min"]).all() and (inner <= child["bound"]["max"]).all()


def test_the_sky_is_the_environment_and_in_no_leaf(tmp_path) -> None:
    """Its boxes would contain every camera, and viewers would load the finest level."""
    gaussians = sample(60, 0).as_arrays()
    gaussians.means[50:] *= 1000
    rows = reduce_gaussians(gaussians, 3, 0.0, True)
    sky = rows.rows >= 50
    write_streamed_sog(tmp_path, rows, sky=sky, blocks=np.ones(60, np.intp), antialias=True)
    meta = read_meta(tmp_path)
    assert meta["environment"] == "env/meta.json" and meta["counts"][0] == 50
    assert "env/meta.json" not in meta["filenames"]
    path = tmp_path / meta["environment"]
    assert len(read_gaussians(path, [])) == 10 and is_antialiased(path)
    assert np.abs(meta["tree"]["bound"]["max"]).max() < np.abs(gaussians.means[50:]).max()


@pytest.mark.parametrize("share", [0, 40])
def test_there_is_no_environment_without_sky_or_scene(tmp_path, share) -> None:
    sky = np.arange(40) < share
    write_streamed_sog(tmp_path, reduce_gaussians(sample(40, 0).as_arrays(), 3, 0.0, True), sky=sky)
    meta = read_meta(tmp_path)
    assert "environment" not in meta and meta["counts"][0] == 40


@pytest.mark.parametrize("blocks", [None, np.repeat([1, 2], 20)])
def test_a_large_sky_is_the_first_branch_of_the_tree(tmp_path, monkeypatch, blocks) -> None:
    """The first picture stays small, and the boxes of other leaves too."""
    monkeypatch.setattr(streamed_sog, "FIRST_PICTURE", 10)
    sky = np.arange(40) % 2 == 1
    rows = reduce_gaussians(sample(40, 0).as_arrays(), 3, 0.0, True)
    write_streamed_sog(tmp_path, rows, sky=sky, blocks=blocks)
    meta = read_meta(tmp_path)
    assert "environment" not in meta and meta["counts"][0] == 40
    counts = [branch["lods"]["0"]["count"] for branch in meta["tree"]["children"]]
    assert counts == ([20, 20] if blocks is None else [20, 10, 10])


def test_a_scene_of_one_gaussian_is_written(tmp_path) -> None:
    write_streamed_sog(tmp_path, reduce_gaussians(sample(1, 0).as_arrays(), 3, 0.0, True))
    meta = read_meta(tmp_path)
    assert meta["counts"] == [1] * LEVELS and "children" not in meta["tree"]
