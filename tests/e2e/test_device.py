"""A scene trained, evaluated and exported on a GPU."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.e2e.harness import TINY, copy_run, metrics, rules_run, snakemake
from tests.tools import need_gpu

pytestmark = pytest.mark.slow

#: Few steps: the GPU is software on most machines that run the tests.
SHORT = TINY | {"train": {**TINY["train"], "steps": 60}}
ON_GPU = SHORT | {"train": {**SHORT["train"], "device": "gpu"}}


def test_a_scene_on_a_gpu_is_as_good_as_on_the_processor(finished: Path, tmp_path: Path) -> None:
    need_gpu()
    project = copy_run(finished, tmp_path / "project")
    snakemake(project, "results/tiny/metrics.json", config=SHORT)
    before = metrics(project, "tiny")
    done = snakemake(project, "results/tiny/metrics.json", config=ON_GPU)
    plan = (project / "results/tiny/plan.json").read_text()
    assert "trained on GPU 0, as configured" in plan
    # What no kernel of training computes stays.
    assert rules_run(done) == {"train", "evaluate", "coverage", "export", "report", "plan"}
    after = metrics(project, "tiny")
    assert after["train_psnr"] == pytest.approx(before["train_psnr"], abs=0.2)
    # Three test views: the rounding of another instruction set moves their mean by up to 0.4 dB.
    assert after["psnr"] == pytest.approx(before["psnr"], abs=0.6)
    assert after["ssim"] == pytest.approx(before["ssim"], abs=0.02)
    assert (before["device"], after["device"]) == ("cpu", "gpu")
    for stage in ("train", "evaluate", "coverage", "export"):
        key = json.loads((project / "results" / "tiny" / stage / "stage.json").read_text())["key"]
        assert key["config"]["train"]["device"] == "gpu:0", stage
        assert key["packages"]["wgpu"] and key["gpu_source"], stage
    log = (project / "results" / "tiny" / "logs" / "train.log").read_text()
    assert "MB of its memory for up to 6000 Gaussians" in log

    # The device of the processor is not part of a key.
    again = snakemake(project, "results/tiny/metrics.json", config=SHORT)
    assert rules_run(again) >= {"train", "evaluate"}
    assert metrics(project, "tiny")["psnr"] == before["psnr"]
