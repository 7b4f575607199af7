"""metrics.json: gathered from records, the same on any machine; times come from run.json."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from pipeline.photos.counters import DecodeCounters
from pipeline.plan.record import PlanRecord
from pipeline.plan.values import StagePlan
from pipeline.reporting.collect import collect_metrics
from pipeline.reporting.headline import finished_line, headline, result_lines
from pipeline.reporting.metrics import Metrics, read_metrics, read_runs, with_times
from pipeline.runtime.atomic import write_json
from pipeline.runtime.counters import NoCounters, StageCounters
from pipeline.runtime.errors import UserError
from pipeline.runtime.record import RunRecord, StageRecord
from tests.counters import INSPECT, REFINE, SFM, TRAIN
from tests.plans import record_of
from tests.reporting.made import evaluation

COUNTERS: dict[str, StageCounters] = {
    "inspect": INSPECT,
    "sfm": SFM,
    "train": TRAIN,
    "report": NoCounters(),
}
PLAN = record_of(
    {name: StagePlan(run=True, reason="needed") for name in COUNTERS}
    | {"decode": StagePlan(run=False, reason="no RAW files")},
    ["it is dark"],
)


def run(wall: float, **more) -> RunRecord:
    facts = {"wall_s": wall, "cpu_s": 2 * wall, "peak_rss_mb": 100.0, "threads": 2, "seed": 0}
    return RunRecord(**facts, versions={}, commit=None, finished="2026-01-01T00:00:00", **more)


@pytest.fixture
def folder(tmp_path):
    """A finished scene's records."""
    scene = tmp_path / "barn"
    write_records(scene, COUNTERS)
    found = collect(scene, PLAN)
    found.write(scene / "report")
    return scene


def collect(scene: Path, plan: PlanRecord) -> Metrics:
    return collect_metrics("barn", plan, scene, evaluation(), seed=3, versions={"torch": "2"})


def write_records(scene: Path, counters_of: Mapping[str, StageCounters]) -> None:
    for name, counters in counters_of.items():
        record = StageRecord(
            stage=name,
            scene="barn",
            key={},
            inputs={},
            outputs={},
            counters=counters.recorded(),
            decisions=(),
            warnings=("it is dark", f"{name} is unsure") if name == "sfm" else (),
        )
        write_json(scene / name / "stage.json", record.model_dump(mode="json"))
        more = {"earlier_s": 2.0} if name == "train" else {}
        write_json(scene / name / "run.json", run(3.0, **more).model_dump(mode="json"))


def test_metrics_come_from_the_records_and_hold_no_times(folder):
    found = read_metrics(folder)
    assert (found.psnr, found.num_gaussians, found.sfm_verdict) == (27.5, 1000, "good")
    assert (found.registered_images, found.total_images, found.seed) == (6, 8, 3)
    assert found.warnings == ["it is dark", "sfm: sfm is unsure"], "each once"
    assert found.stages["decode"].skipped and not found.stages["train"].skipped
    assert "_s" not in "".join(found.stages["train"].model_dump())
    assert json.loads((folder / "report" / "metrics.json").read_text())["schema_version"] == 1


def test_given_poses_count_as_registered_and_have_the_error_of_their_adjustment(tmp_path):
    given = INSPECT.model_copy(update={"given_poses": 5, "given_points": 0})
    write_records(tmp_path, {"inspect": given, "refine": REFINE, "train": TRAIN})
    ran = {name: StagePlan(run=True, reason="") for name in ("inspect", "refine", "train")}
    found = collect(tmp_path, record_of(ran))
    assert (found.registered_images, found.reprojection_error_px) == (5, REFINE.error_px)
    assert found.sfm_verdict is None and found.georeference is None
    (tmp_path / "refine" / "stage.json").unlink()
    del ran["refine"]
    assert collect(tmp_path, record_of(ran)).reprojection_error_px is None


def test_chosen_frames_of_videos_count_as_images_of_the_scene(tmp_path):
    frames = DecodeCounters(developed=0, frames_chosen={"a": 20, "b": 11}, frames_decoded={})
    write_records(tmp_path, {**COUNTERS, "decode": frames})
    ran = {name: StagePlan(run=True, reason="") for name in (*COUNTERS, "decode")}
    assert collect(tmp_path, record_of(ran)).total_images == 8 + 31


@pytest.mark.parametrize("name", ["inspect", "sfm", "train"])
def test_damaged_counters_are_one_clear_error(folder, name):
    file = folder / name / "stage.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"counters": {"frames": 3}}))
    with pytest.raises(UserError, match=rf"{name}/stage.json: cannot be read.*\n.*forcerun {name}"):
        collect(folder, PLAN)


def test_times_are_those_of_the_runs_and_of_killed_ones_before(folder):
    found = read_metrics(folder)
    stages = with_times(found, read_runs(found, folder)).stages
    assert stages["train"].wall_s == 5.0 and stages["sfm"].wall_s == 3.0
    assert stages["decode"].wall_s == 0.0 and stages["sfm"].cpu_s == 6.0


def test_the_result_has_quality_size_poses_time_and_paths(folder):
    line = "PSNR 27.50 dB, SSIM 0.9000, FLIP 0.080, 1,000 Gaussians, 6 of 8 photographs, 2 warnings"
    assert headline(read_metrics(folder)) == line
    assert finished_line(folder) == f"barn: Good: {line}, 14 s"
    (folder / "export").mkdir()
    for name in ("scene.spz", "stage.json"):
        (folder / "export" / name).touch()
    lines = result_lines(folder)
    assert lines[0] == "barn: Good: 6 of 8 photographs placed; sharp where photographed."
    assert lines[1:3] == [f"  {line}, 14 s", f"  page     {folder / 'report.html'}"]
    assert lines[3] == f"  exports  {folder / 'export'}: scene.spz"


@pytest.mark.parametrize("name", ["report/metrics.json", "sfm/run.json"])
def test_a_damaged_file_is_one_clear_error(folder, name):
    (folder / name).write_text('{"psnr": ')
    with pytest.raises(UserError, match=f"{name}: .*damaged"):
        read_runs(read_metrics(folder), folder)


def test_a_value_that_is_no_number_is_rejected():
    with pytest.raises(ValueError, match="psnr"):
        Metrics.model_validate({"psnr": "good"})
