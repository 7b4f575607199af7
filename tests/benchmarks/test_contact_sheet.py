"""A view under every configuration, side by side."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.contact_sheet import GAP, LABEL, sheet
from pipeline.metrics.evaluation import SceneQuality, ViewMetrics
from pipeline.reporting.metrics import Metrics
from pipeline.runtime.errors import UserError
from tests.reporting.made import evaluation


def batch(folder: Path) -> Path:
    """Two runs of a scene, of which each render has a colour of its own, and one that failed."""
    rows = []
    for i, config in enumerate(("plain", "other", "lost")):
        status = "failed" if config == "lost" else "ok"
        rows.append({"scene": "room", "config": config, "seed": 0, "status": status})
        renders = folder / f"room@{config}" / "evaluate" / "renders"
        renders.mkdir(parents=True)
        views = []
        for k in range(3):
            shade = (100 * i, 80 * k, 255)
            Image.new("RGB", (40, 30), shade).save(renders / f"{k}.png")
            view = ViewMetrics(
                name=f"view_{k}.png", psnr=20.0 + k, ssim=0.9, lpips=None, render=f"{k}.png"
            )
            views.append(view)
        metrics = Metrics(
            **{name: getattr(evaluation(*views), name) for name in SceneQuality.model_fields},
            scene="room",
            input="3 photographs; poses: none",
            seed=0,
            num_gaussians=1000,
            registered_images=3,
            total_images=3,
            reprojection_error_px=None,
            sfm_verdict=None,
            georeference=None,
            stages={},
            versions={},
            warnings=[],
        )
        metrics.write(renders.parents[1] / "report")
    path = folder / "benchmark.json"
    path.write_text(json.dumps({"runs": rows}))
    return path


def test_the_same_view_of_every_run_that_finished(tmp_path: Path) -> None:
    picture = np.asarray(sheet(batch(tmp_path), "room", [], None, 20, 4))
    assert picture.shape == (15 + LABEL + 2 * GAP, 2 * (20 + GAP) + GAP, 3)
    # The median view of the first, and the same one of the other.
    assert picture[GAP + 7, GAP + 10].tolist() == [0, 80, 255]
    assert picture[GAP + 7, 2 * GAP + 30].tolist() == [100, 80, 255]
    below = np.asarray(sheet(batch(tmp_path / "b"), "room", ["other"], "view_2.png", 20, 4))
    assert below[GAP + 7, GAP + 10].tolist() == [100, 160, 255]


def test_the_photograph_comes_first(tmp_path: Path) -> None:
    path = batch(tmp_path)
    with pytest.raises(UserError, match="not undistorted"):
        sheet(path, "room", ["plain"], None, 20, 4, photograph=True)
    images = tmp_path / "room@plain" / "undistort" / "images"
    images.mkdir(parents=True)
    Image.new("RGB", (40, 30), (9, 9, 9)).save(images / "view_1.png")
    picture = np.asarray(sheet(path, "room", ["plain"], None, 20, 4, photograph=True))
    assert picture[GAP + 7, GAP + 10].tolist() == [9, 9, 9]
    assert picture[GAP + 7, 2 * GAP + 30].tolist() == [0, 80, 255]


@pytest.mark.parametrize(
    ("scene", "configs", "view", "told"),
    [
        ("hall", [], None, "no finished run hall"),
        ("room", ["lost"], None, "room@plain, room@other"),
        ("room", [], "view_9.png", "view_0.png, view_1.png"),
    ],
)
def test_what_is_not_there_is_named(
    tmp_path: Path, scene: str, configs: list[str], view: str | None, told: str
) -> None:
    with pytest.raises(UserError, match=told):
        sheet(batch(tmp_path), scene, configs, view, 20, 4)
