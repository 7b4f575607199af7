"""The tiny synthetic scene through Snakemake itself: result, caching, kills, determinism."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from types import SimpleNamespace

import pytest
from PIL import Image
from snakemake.cli import get_argument_parser, parse_config

from pipeline.config.export import PLACED_FORMATS
from pipeline.coverage.record import CoverageRecord
from pipeline.io.frame_json import Frame
from pipeline.metrics.evaluation import Evaluation
from pipeline.plan.record import read_plan
from pipeline.reporting.metrics import Metrics
from pipeline.runtime.counters import read_counters
from pipeline.runtime.errors import UserError
from pipeline.scene.background import SceneBackground
from pipeline.scene.exposure import ExposureGains
from pipeline.scene.georeference import Georeference
from pipeline.sfm.uncertainty_file import Uncertainty
from pipeline.training.loop.curve import TrainingCurve
from stages.workflow.project import SnakemakeProject
from stages.workflow.registry import STAGES
from tests.documented import commands
from tests.e2e.harness import (
    TINY,
    copy_run,
    copy_sources,
    metrics,
    model_digests,
    rules_run,
    snakemake,
    start_and_kill,
    started,
)
from tests.stages.flow import dry_run

pytestmark = pytest.mark.slow

TARGET = "results/tiny/metrics.json"


@pytest.fixture
def project(finished, tmp_path):
    return copy_run(finished, tmp_path / "project")


def test_photographs_become_a_scene(finished):
    found = json.loads((finished / TARGET).read_text())
    assert found["registered_images"] == found["total_images"]
    assert found["pose_error"]["rotation_median_deg"] < 0.3
    assert found["psnr"] > 20
    assert 0.5 < found["ssim"] <= 1
    assert found["lpips"] is None
    assert "splatmake fetch lpips" in found["lpips_reason"]
    assert 0 < found["flip"] < 0.3
    assert found["stages"]["decode"]["skipped"]
    assert not found["stages"]["train"]["skipped"]
    Metrics.model_validate(found)
    assert str(finished) not in json.dumps(found), "metrics.json holds a path of this machine"
    assert found["protocol"]["num_views"] == len(found["per_view"])
    folder = finished / "results/tiny"
    for name in (
        "plan.json",
        "report.html",
        "export/point_cloud.ply",
        "export/sparse/0/images.bin",
    ):
        assert (folder / name).stat().st_size > 0
    assert not list((folder / ".scratch").glob("*/*/out")), "half output was left"
    logs = [p.read_bytes() for p in (folder / "logs").glob("*.log")]
    assert logs
    assert not any(b"\r" in log for log in logs)


def test_counters_and_plan_fit_their_models(finished, tmp_path):
    folder = finished / "results/tiny"
    plan = read_plan(folder)
    ran = [name for name in plan.order if plan.stages[name].run]
    assert list(STAGES) == plan.order and "train" in ran
    for name in ran:
        record = json.loads((folder / name / "stage.json").read_text())
        model = STAGES[name].counters
        assert read_counters(folder / name, model).recorded() == record["counters"]
        record["counters"]["unknown"] = 1
        (tmp_path / name).mkdir()
        (tmp_path / name / "stage.json").write_text(json.dumps(record))
        with pytest.raises(UserError, match=f"{name}/stage.json: cannot be read.*\n.*{name}$"):
            read_counters(tmp_path / name, model)


# Files that others read with their own models, or that have another program's format.
RECORDS = {"stage.json", ".stage.json", "run.json", "images.json", "transforms.json"}
MODELS = (
    *(Metrics, Evaluation, CoverageRecord, Georeference, Frame, TrainingCurve, ExposureGains),
    *(SceneBackground, Uncertainty),
)


def test_every_json_file_of_a_stage_is_what_its_model_writes(finished, tmp_path):
    models = {model.file_name: model for model in MODELS}
    found = set()
    for file in (finished / "results/tiny").glob("[a-z]*/*.json"):
        if file.name in RECORDS:
            continue
        found.add(file.name)
        models[file.name].read(file.parent).write(tmp_path)
        assert (tmp_path / file.name).read_bytes() == file.read_bytes(), file
    assert found == models.keys()


def test_an_export_option_never_retrains_and_a_second_run_does_nothing(project):
    config = TINY | {"experiments": {"export": {"min_opacity": 0.1}}}
    done = snakemake(project, TARGET, config=config)
    assert rules_run(done) == {"export", "report"}
    assert not started(snakemake(project, TARGET, config=config))


def test_touched_photographs_and_comments_rerun_nothing(project):
    """The photographs are from the future, as after a clock that was set back."""
    copy_sources(project)
    later = time.time() + 10 * 86400
    for photo in (project / "data/tiny/images").iterdir():
        os.utime(photo, (later, later))
    for name in ("training/loop/trainer.py", "sfm/mapping.py", "io/colmap.py"):
        file = project / "pipeline" / name
        file.write_text("# A comment.\n" + file.read_text() + "\n# Another.\n")
    kernel = next((project / "pipeline/render/cpu/csrc").glob("*.h"))
    kernel.write_text("// A comment.\n" + kernel.read_text())
    dry = snakemake(project, "-n", TARGET, config=TINY)
    assert rules_run(dry) == set() and "tiny: up to date" in dry.stdout


def test_changed_code_reruns_its_stage_and_unchanged_results_stop_there(project):
    """The export's code changes, its files don't: the page is not made again."""
    copy_sources(project)
    file = project / "stages/export.py"
    file.write_text(file.read_text() + "\nUNUSED = 1\n")
    page = project / "results/tiny/report/report.html"
    before = page.stat().st_mtime_ns
    done = snakemake(project, TARGET, config=TINY)
    assert "export" in rules_run(done)
    assert "train" not in rules_run(done)
    assert page.stat().st_mtime_ns == before


def test_a_changed_mask_is_noticed_and_new_truth_measures_only(project):
    """What stands beside the photographs counts as they do; ground truth is never an input."""
    truth = project / "data/tiny/sparse_gt"
    aside = truth.rename(truth.with_name("aside"))
    measured = "results/tiny/evaluate"
    snakemake(project, f"{measured}/stage.json", config=TINY)
    found = json.loads((project / measured / "evaluation.json").read_text())
    assert found["pose_error"] is None
    model = (project / "results/tiny/train/gaussians.npz").stat().st_mtime_ns
    aside.rename(truth)
    done = snakemake(project, TARGET, config=TINY)
    assert json.loads((project / TARGET).read_text())["pose_error"] is not None
    assert done.stderr.count("up to date, nothing to do") >= 5
    assert (project / "results/tiny/train/gaussians.npz").stat().st_mtime_ns == model
    masks = project / "data/tiny/masks"
    masks.mkdir()
    for photo in (project / "data/tiny/images").iterdir():
        Image.new("L", Image.open(photo).size, 255).save(masks / f"{photo.stem}.png")
    features = "results/tiny/features/stage.json"
    assert "features" in rules_run(snakemake(project, features, config=TINY))
    assert rules_run(snakemake(project, "-n", features, config=TINY)) == set()
    Image.new("L", Image.open(photo).size, 0).save(masks / f"{photo.stem}.png")
    assert "features" in rules_run(snakemake(project, "-n", features, config=TINY))


# What the tiny scene or this machine lacks: ground control points, a published benchmark.
NOT_PLANNED = {
    'sfm={"georeference": "gcp"}',
    'split={"source": "published"}',
    'split={"source": "published", "train_views": 3}',
}


def test_the_configurations_in_commands_of_the_docs_are_planned(project, monkeypatch):
    monkeypatch.chdir(project)
    monkeypatch.setattr(os, "environ", os.environ.copy())
    options = [
        tuple(get_argument_parser().parse_args(command.words[1:]).config or ())
        for command in commands()
        if command.program == "snakemake"
    ]
    placed = re.compile("|".join(PLACED_FORMATS))
    planned = [
        values
        for values in dict.fromkeys(options)
        if not NOT_PLANNED & {*values} and not any(map(placed.search, values))
    ]
    assert len(planned) >= 8
    for values in planned:
        config = parse_config(list(values)) | {"data_root": "data"}
        plan = json.loads(SnakemakeProject(config, dry_run()).plan(SimpleNamespace(scene="tiny")))
        assert plan["stages"]["train"]["run"], values


def test_kill_9_and_again_on_one_core_gives_the_bytes_of_two(project, finished):
    """From the photographs on, killed in mapping, before training's first checkpoint and after
    one, and in evaluation."""
    copy_sources(project)
    trainer = project / "pipeline/training/loop/session.py"
    text = trainer.read_text()
    often = text.replace("CHECKPOINT_SECONDS = 30.0", "CHECKPOINT_SECONDS = 0.2")
    assert often != text
    trainer.write_text(often)
    folder = project / "results/tiny"
    shutil.rmtree(project / "results")
    shutil.rmtree(project / ".snakemake")
    scratch = "results/tiny/.scratch"
    # Whole checkpoints alone: the temporary file of the first may be all that a kill leaves.
    for stage, ready in (
        ("sfm", "*/out"),
        ("train", "*/out"),
        ("train", "*/checkpoints/checkpoint_*.sha256"),
        ("evaluate", "*/out/renders/*.png"),
    ):
        ready = f"{scratch}/{stage}/{ready}"
        assert not list(project.glob(ready)) or ready.endswith("out")
        start_and_kill(project, TARGET, ready, config=TINY, cores=1)
        assert list(project.glob(ready))
        assert not (folder / stage / "stage.json").exists()
    snakemake(project, TARGET, config=TINY, cores=1)
    assert "resuming at" in (folder / "logs/train.log").read_text()
    assert not (project / scratch / "train").exists()
    assert metrics(project, "tiny") == metrics(finished, "tiny")
    assert model_digests(project, "tiny") == model_digests(finished, "tiny")


def test_progress_is_written_for_people_and_programs(finished):
    folder = finished / "results/tiny"
    assert "steps/s" in (folder / "logs/train.log").read_text()
    assert " left" in (folder / "logs/train.log").read_text()
    state = json.loads((folder / ".scratch/progress/train.json").read_text())
    assert {"label", "done", "total", "rate", "seconds_left"} <= state.keys()
