"""Files that change between the stage that recorded them and the one that reads them."""

from __future__ import annotations

import json
import os
import re
import shutil

import pytest

from tests.e2e.harness import TINY, copy_run, copy_sources, metrics, rules_run, snakemake

pytestmark = pytest.mark.slow

FEATURES = "results/{}/features/stage.json"


@pytest.fixture
def project(finished, tmp_path):
    return copy_run(finished, tmp_path / "project")


def features_of(project, scene):
    return json.loads((project / FEATURES.format(scene)).read_text())["outputs"]


def test_a_photograph_replaced_while_snakemake_runs(project):
    """Same size, same time: the error names it, and the next run equals a fresh one.

    The project's inspect stage is changed to replace the photograph when it has recorded it.
    """
    shutil.rmtree(project / "results")
    images = project / "data" / "tiny" / "images"
    first, other = sorted(images.iterdir())[:2]
    copy_sources(project)
    stage = project / "stages" / "inspect.py"
    written = 'manifest.write(job.out / "images.json")'
    assert written in stage.read_text()
    swap = f"{written}\n    if Path('swap.png').exists():\n        Path('swap.png').replace("
    stage.write_text(stage.read_text().replace(written, f"{swap}'{first}')"))
    time = first.stat().st_mtime_ns
    shutil.copy(other, project / "swap.png")
    os.utime(project / "swap.png", ns=(time, time))

    done = snakemake(project, FEATURES.format("tiny"), config=TINY, check=False)
    assert done.returncode != 0 and "Traceback" not in done.stdout
    assert f"{first.name}: has changed since the scene was inspected" in done.stdout
    assert "run the same command again" in done.stdout

    snakemake(project, FEATURES.format("tiny"), config=TINY)
    shutil.copytree(project / "data" / "tiny", project / "data" / "fresh")
    snakemake(project, FEATURES.format("fresh"), config=TINY)
    assert features_of(project, "tiny") == features_of(project, "fresh")


def test_a_camera_moved_in_a_stages_output_is_named_and_the_command_repairs_it(project, finished):
    """The error's own command makes the stage's output again, and the result is the former one."""
    scene = project / "results" / "tiny"
    model = scene / "undistort" / "sparse" / "0" / "images.bin"
    whole = model.read_bytes()
    data = bytearray(whole)
    data[60] ^= 1  # inside the first image's pose
    model.write_bytes(data)
    shutil.rmtree(scene / "train")
    (scene / "metrics.json").unlink()
    target = "results/tiny/metrics.json"
    done = snakemake(project, target, config=TINY, check=False)
    assert done.returncode != 0 and "Traceback" not in done.stdout
    assert (
        f"{model.relative_to(project)}: has changed since stage undistort wrote it" in done.stdout
    )
    (advice,) = set(re.findall(r"as in: snakemake --cores all (.*)", done.stdout))
    done = snakemake(project, *advice.split(), config=TINY)
    assert "undistort" in rules_run(done)
    assert model.read_bytes() == whole
    assert metrics(project, "tiny") == metrics(finished, "tiny")


def test_copied_results_are_made_again_where_options_have_changed(project):
    """Without Snakemake's own records, as after copying results to another machine."""
    shutil.rmtree(project / ".snakemake")
    unchanged = snakemake(project, "-n", "results/tiny/metrics.json", config=TINY)
    assert rules_run(unchanged) == set()
    changed = TINY | {"experiments": {"train": {"scales_learning_rate": 0.004}}}
    done = snakemake(project, "-n", "results/tiny/metrics.json", config=changed)
    assert rules_run(done) == {"train", "evaluate", "coverage", "export", "report"}
    by_time = ("--rerun-triggers", "mtime")
    done = snakemake(project, "-n", "results/tiny/metrics.json", *by_time, config=changed)
    assert rules_run(done) == set()


def test_a_damaged_record_is_one_clear_error(project):
    record = project / "results" / "tiny" / "sfm" / "stage.json"
    whole = record.read_text()
    record.write_text('{"stage": "sfm"}')
    target = "results/tiny/undistort/stage.json"
    done = snakemake(project, target, config=TINY, check=False)
    assert done.returncode != 0 and "Traceback" not in done.stdout
    assert "sfm/stage.json: cannot be read" in done.stdout
    done = snakemake(project, target, "--forcerun", "sfm", config=TINY)
    assert "up to date, nothing to do" in done.stdout
    assert record.read_text() == whole
