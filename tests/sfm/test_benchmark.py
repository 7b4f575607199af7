"""benchmarks.sfm: choice of configurations, summaries, and a run."""

from __future__ import annotations

import json

import pytest

from benchmarks import record_tables
from benchmarks.measured import Record
from benchmarks.sfm.__main__ import main
from benchmarks.sfm.scenes import configurations, load_scene
from benchmarks.sfm.summary import Cost, Run, summarise, table
from pipeline.demo.write import DemoSpec, write_demo
from pipeline.metrics.pose import PoseError
from pipeline.runtime.errors import UserError

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
    error = None if rotation is None else ERROR.model_copy(update={"rotation_median_deg": rotation})
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


def test_the_table_compares_with_pycolmap():
    rows = [summarise([run(10, 0.5, "pycolmap")]), summarise([run(2, 0.1)])]
    lines = table(rows).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert "| 6.0 | 0.20 | 0.1000 |" in lines[-1]


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
    main([*arguments, "--json", str(tmp_path / "a.json")])
    record = json.loads((tmp_path / "a.json").read_text())
    reference, ours = Record[Run].model_validate(record).results
    assert (reference.configuration, reference.planned) == ("pycolmap", False)
    assert ours.planned and ours.registered == reference.registered == 6
    summary = summarise([ours])
    assert summary.rotation_deg < 0.3 and summary.centre_permille < 20
    assert all(cost.cpu_s > 0 for run in (reference, ours) for cost in run.costs.values())
    assert "| demo | **fast/incremental/exhaustive** |" in record_tables.table_of("sfm", [record])
    assert record_tables.table_of("sfm", [record]) in capsys.readouterr().out
    assert record["command"] == f"python -m benchmarks.sfm {' '.join(arguments)} --json FILE"


def test_finished_runs_are_kept_when_one_dies(demo, tmp_path, monkeypatch):
    runs = [run(10, 0.5, "pycolmap")]

    def dying(*_):
        if not runs:
            raise KeyboardInterrupt
        return runs.pop()

    monkeypatch.setattr("benchmarks.sfm.__main__.run_once", dying)
    file = tmp_path / "a.json"
    with pytest.raises(KeyboardInterrupt):
        main([str(demo), "--configs", "pycolmap", "--repeats", "2", "--json", str(file)])
    (kept,) = Record[Run].model_validate(json.loads(file.read_text())).results
    assert kept.configuration == "pycolmap"
