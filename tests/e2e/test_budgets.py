"""A finished scene as a point of quality by training time, and another trainer beside it."""

from __future__ import annotations

import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.budgets.opensplat import OpenSplat, measure, write_project
from benchmarks.budgets.points import OURS, Setup, measured_point
from pipeline.io.colmap import read_model
from pipeline.plan.posed_scene import posed_scene
from tests.e2e.harness import copy_run, metrics

pytestmark = pytest.mark.slow


@pytest.fixture
def results(finished: Path, tmp_path: Path) -> Path:
    """The results folder of the finished scene."""
    return copy_run(finished, tmp_path / "project") / "results" / "tiny"


def test_a_finished_run_is_a_point(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Setup, "results", lambda *_: results)
    point = measured_point(Setup(Path(), Path(), {}, 1), "tiny", 0, 1.0)
    found = metrics(results.parent.parent, "tiny")
    assert (point.trainer, point.psnr, point.ssim) == (OURS, found["psnr"], found["ssim"])
    assert (point.steps, point.gaussians) == (240, found["num_gaussians"])
    assert point.pixels == ", ".join(found["protocol"]["resolution"])
    assert point.cpu_minutes > 0 and point.other_cpu_minutes is not None
    assert point.benchmark is None and point.deviations == []


def test_another_trainer_gets_the_training_views_and_is_measured_alike(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Given our exported model as its result, it has our quality."""
    project = tmp_path / "opensplat"
    write_project(results, project)
    model = read_model(project / "sparse" / "0")
    views = posed_scene(results, None, None, exported=True).views
    assert len(model.images) == sum(not view.is_test for view in views)
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        with Image.open(project / "images" / image.name) as photo:
            assert photo.size == (camera.width, camera.height)
    right, others = colour_errors(project)
    assert right < 0.5 * others, "points and poses are of different worlds"

    program = tmp_path / "program"
    copied = results / "export" / "point_cloud.ply"
    program.write_text(f"#!/bin/sh\necho 'Step 1: 0'\ncp {copied} \"$7\"\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(Setup, "results", lambda *_: results)
    ours = measured_point(Setup(Path(), Path(), {}, 1), "tiny", 0, 1.0)
    found = measure(OpenSplat(program, 1), "OpenSplat 1", 5, results, project, ours)
    assert found.psnr == pytest.approx(ours.psnr, abs=0.01)
    assert (found.trainer, found.steps, found.other_cpu_minutes) == ("OpenSplat 1", 5, None)
    assert replace(found, **{name: getattr(ours, name) for name in CHANGED}) == ours


CHANGED = (
    *("trainer", "options", "steps", "psnr", "ssim", "lpips", "gaussians", "threads"),
    *("wall_minutes", "cpu_minutes", "other_cpu_minutes", "load_average"),
)


def colour_errors(project: Path) -> tuple[float, float]:
    """Median difference, in grey levels, of points from the pixels of the first image where they
    project to, and of the same pixels from points in another order."""
    model = read_model(project / "sparse" / "0")
    image = next(iter(model.images.values()))
    camera = model.cameras[image.camera_id]
    fx, fy, cx, cy = camera.pinhole
    x, y, z = image.rotation @ model.points.xyz.T + image.translation[:, None]
    column, row = (fx * x / z + cx).astype(int), (fy * y / z + cy).astype(int)
    inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    pixels = np.asarray(Image.open(project / "images" / image.name), float)[
        row[inside], column[inside]
    ]
    rgb = model.points.rgb[inside].astype(float)
    mixed = np.random.default_rng(0).permutation(rgb)
    return tuple(float(np.median(np.abs(pixels - of).mean(1))) for of in (rgb, mixed))
