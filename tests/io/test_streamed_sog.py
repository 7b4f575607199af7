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
    monkeypatch.setattr(streamed_sog, "LEAF", 100)
    rows = reduce_gaussians(sample(330, 1).as_arrays(), 3, 0.0, True)
    write_streamed_sog(tmp_path / "scene", rows, antialias=True)
    return tmp_path / "scene"


def leaves(node: dict[str, Any]) -> list[dict[str, Any]]:
    if "children" not in node:
        return [node]
    return [leaf for child in node["children"] for leaf in leaves(child)]


def inside(inner: dict[str, Any], outer: dict[str, Any]) -> bool:
    low, high = (np.array(inner["bound"][k]) for k in ("min", "max"))
    return bool((low >= outer["bound"]["min"]).all() and (high <= outer["bound"]["max"]).all())


def test_the_index_names_every_file_and_counts_every_gaussian(folder) -> None:
    meta = json.loads((folder / LOD_META).read_text())
    assert meta["version"] == 1 and meta["lodLevels"] == LEVELS
    assert meta["count"] == sum(meta["counts"]) and meta["counts"][0] == 330
    found = {str(p.relative_to(folder)) for p in folder.rglob("meta.json")}
    assert found == set(meta["filenames"])
    seen = leaves(meta["tree"])
    assert len(seen) == 4 and len(meta["filenames"]) == 4 * LEVELS
    for level in range(LEVELS):
        counts = [leaf["lods"][str(level)]["count"] for leaf in seen]
        assert sum(counts) == meta["counts"][level]
        assert level == 0 or max(counts) <= 100 / 2**level + 1


def test_each_leaf_holds_its_gaussians_in_its_box(folder) -> None:
    meta = json.loads((folder / LOD_META).read_text())
    finest = []
    for leaf in leaves(meta["tree"]):
        assert inside(leaf, meta["tree"])
        for level, part in leaf["lods"].items():
            path = folder / meta["filenames"][part["file"]]
            read = read_gaussians(path, [])
            assert path.parent.name.startswith(f"{level}_") and is_antialiased(path)
            assert len(read) == part["count"] and part["offset"] == 0
            means = read.means.numpy()
            assert (means >= np.array(leaf["bound"]["min"]) - 1e-3).all()
            assert (means <= np.array(leaf["bound"]["max"]) + 1e-3).all()
            if level == "0":
                finest.append(means)
    everything = np.concatenate(finest)
    expected = sample(330, 1).means.numpy()
    nearest = np.abs(expected[:, None] - everything[None]).max(2).min(1)
    assert len(everything) == 330 and nearest.max() < 1e-3


def test_a_scene_of_one_gaussian_is_written(tmp_path) -> None:
    write_streamed_sog(tmp_path, reduce_gaussians(sample(1, 0).as_arrays(), 3, 0.0, True))
    meta = json.loads((tmp_path / LOD_META).read_text())
    assert meta["counts"] == [1] * LEVELS and "children" not in meta["tree"]
