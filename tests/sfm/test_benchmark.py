"""benchmarks.sfm: choice of configurations, summaries, and a run."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from benchmarks.sfm.__main__ import main, plot, table
from benchmarks.sfm.mappers import between
from benchmarks.sfm.mappers import tables as mapper_tables
from benchmarks.sfm.measure import Cost, Run, summarise
from benchmarks.sfm.scenes import configurations, load_scene
from pipeline.demo.write import DemoSpec, write_demo
from pipeline.metrics.pose import PoseError
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import PosedImage, Reconstruction

ERROR = PoseError(
    rotation_median_deg=0.1,
    rotation_mean_deg=0.1,
    centre_median=0.02,
    centre_mean=0.02,
    centre_relative_median=0.004,
    radius=5.0,
    scale=1.0,
    auc={1.0: 0.9, 5.0: 1.0, 10.0: 1.0},
    num_common=8,
    num_truth=8,
)


def run(cpu: float, rotation: float | None, name: str = "fast/global/retrieval") -> Run:
    costs = {step: Cost(cpu, 100 + cpu) for step in ("features", "matches", "mapping")}
    error = None if rotation is None else replace(ERROR, rotation_median_deg=rotation)
    return Run("s", name, True, costs, 8 if error else 0, error, "" if error else "no model")


def test_a_summary_is_the_median_of_runs_with_a_model():
    summary = summarise([run(1, 0.3), run(9, None), run(3, 0.1), run(2, 0.2)])
    assert (summary.total_s, summary.cpu_s["matches"]) == (6, 2)
    assert summary.rotation_deg == 0.2 and summary.centre_permille == pytest.approx(4)
    assert (summary.runs, summary.failed, summary.registered) == (4, 1, 8)
    assert summary.peak_mb == 109


def test_runs_without_any_model_have_times_and_no_errors():
    summary = summarise([run(4, None)])
    assert summary.total_s == 12 and summary.rotation_deg is None and summary.failed == 1
    line = table([summary]).splitlines()[-1]
    assert "1 of 1 runs failed" in line and "| - |" in line
    assert plot([summary]).startswith("<svg")


def test_table_and_plot_compare_with_pycolmap():
    rows = [summarise([run(10, 0.5, "pycolmap")]), summarise([run(2, 0.1)])]
    lines = table(rows).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert "| 6.0 | 0.20 | 0.1000 |" in lines[-1]
    drawn = plot(rows)
    assert drawn.count("<circle") == 2 and ">fast glo ret</text>" in drawn
    worse = replace(rows[0], configuration="high/global/retrieval", planned=False)
    drawn = plot([*rows, worse])
    assert drawn.count("<circle") == 3 and ">high glo ret</text>" not in drawn


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "demo"
    write_demo(folder, DemoSpec(views=6, width=200, height=150))
    return folder


def test_patterns_select_configurations_that_are_possible(demo):
    scene = load_scene(demo)
    assert len(scene.manifest.photos) == len(scene.truth.images) == 6
    names = {c.name: c.planned for c in configurations(scene, ["balanced/*", "plan"])}
    # No GPS. The plan's choice under the other presets is added.
    assert not any("spatial" in name for name in names)
    assert {n for n, planned in names.items() if planned} == {
        f"{preset}/incremental/exhaustive" for preset in ("fast", "balanced", "high", "original")
    }
    assert {n.split("/")[1] for n in names} == {"incremental", "global"}
    fast = configurations(scene, ["fast/*/exhaustive"])
    assert {c.config.features.max_features for c in fast} == {3000}


def test_every_thins_photographs_and_true_poses_alike(demo):
    scene = load_scene(demo, every=3)
    assert len(scene.manifest.photos) == len(scene.truth.images) == 2


def test_a_folder_without_poses_is_an_error(demo, tmp_path):
    (tmp_path / "images").symlink_to(demo / "images")
    with pytest.raises(UserError, match="no poses to measure against"):
        load_scene(tmp_path)


def test_a_run_measures_the_pipeline_and_pycolmap(demo, tmp_path, capsys):
    arguments = [str(demo), "--configs", "pycolmap", "fast/incremental/exhaustive"]
    main([*arguments, "--json", str(tmp_path / "a.json"), "--plot", str(tmp_path / "a.svg")])
    found = json.loads((tmp_path / "a.json").read_text())
    reference, ours = found["summaries"]
    assert (reference["configuration"], reference["planned"]) == ("pycolmap", False)
    assert ours["planned"] and ours["registered"] == reference["registered"] == 6
    assert ours["rotation_deg"] < 0.3 and ours["centre_permille"] < 20
    assert all(cost["cpu_s"] > 0 for run in found["runs"] for cost in run["costs"].values())
    assert re.search(r"\| demo \| \*\*fast/incremental/exhaustive\*\* \|", capsys.readouterr().out)
    assert "<circle" in (tmp_path / "a.svg").read_text()


def test_interpolated_views_lie_between_neighbouring_cameras():
    # Cameras on a line with equal rotations except for one.
    rotated = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    images = {}
    for i in range(6):
        rotation = rotated if i == 5 else np.eye(3)
        images[i] = PosedImage(f"{i}.jpg", 1, rotation, -rotation @ np.array([float(i * i), 0, 0]))
    model = Reconstruction({}, images)
    found = between(model, 40)
    again = between(model, 40)
    for (rotation, centre), (same, _) in zip(found, again, strict=True):
        np.testing.assert_array_equal(rotation, same)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert 0 <= centre[0] <= 25 and not centre[1:].any()
        if centre[0] <= 9:
            np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
    assert len({float(centre[0]) for _, centre in found}) == 40


def test_the_mappers_table_separates_seeds_and_mappers():
    names = [(mapper, seed) for mapper in ("incremental", "global") for seed in (0, 1)]
    costs = {name: Cost(10.0 if name[0] == "global" else 4.0, 1.0) for name in names}
    likeness = {
        (a, b): (35.0, 0.99) if a[0] == b[0] else (30.0, 0.95) for a, b in combinations(names, 2)
    }
    lines = mapper_tables({"s": (costs, likeness)}).splitlines()
    assert "| s | 4.0 | 10.0 |" in lines
    assert (
        "| s | global, two seeds | 1 | 35.00 (35.00 to 35.00) | 0.9900 (0.9900 to 0.9900) |"
        in lines
    )
    assert any(line.startswith("| s | incremental against global | 4 | 30.00") for line in lines)
