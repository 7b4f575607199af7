"""Tables from the benchmark.json of a batch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.command.main import main
from pipeline.reporting import compare


def row(scene: str, config: str, psnr: float, **changes: Any) -> dict[str, Any]:
    stages = ("decode", "features", "matches", "sfm", "undistort", "train")
    quality = dict.fromkeys(compare.QUALITY, 1.0)
    return {
        **quality,
        **{f"{stage}_cpu_s": 10.0 for stage in stages},
        "refine_cpu_s": None,
        **{"scene": scene, "config": config, "seed": 0, "status": "ok", "psnr": psnr},
        **{"ssim": psnr / 40, "num_gaussians": 50_000, "wall_s": 30.0, "cpu_s": 60.0},
        **changes,
    }


def test_configurations_are_compared_with_the_base() -> None:
    lines = compare.against(
        [
            row("a", "plan", 30.0),
            row("b", "plan", 20.0),
            row("a", "other", 31.0, train_cpu_s=70.0),
            row("b", "other", 20.5, decode_cpu_s=None),
            row("b", "broken", 0.0, status="failed", message="no poses"),
        ],
        "plan",
    )
    assert lines[0].startswith("| | a | b | mean |")
    assert lines[2] == (
        "| **plan** | 30.00 dB, .750, 60 s | 20.00 dB, .500, 60 s |  | 50, 10 | 50k |"
    )
    assert lines[3] == (
        "| other | +1.00, +.025, +60 s | +0.50, +.012, -10 s | +0.75 dB | 45, 40 | 50k |"
    )
    assert lines[4] == "| broken | no run | failed: no poses |  |  |  |"
    assert {line.count("|") for line in lines} == {lines[0].count("|")}


def test_several_seeds_give_medians_and_spreads() -> None:
    """Compared seed by seed, so that the effect of a seed on both cancels."""
    lines = compare.against(
        [
            row("a", "plan", 30.0),
            row("a", "plan", 31.0, seed=1, train_cpu_s=20.0),
            row("a", "other", 30.5),
            row("a", "other", 31.1, seed=1, train_cpu_s=30.0),
            row("a", "late", 32.0, seed=1, train_cpu_s=10.0),
        ],
        "plan",
    )
    assert lines[2] == "| **plan** | 30.50 ±0.50 dB, .762, 65 ±5 s |  | 50, 15 | 50k |"
    assert lines[3] == "| other | +0.30 ±0.20, +.008, +5 ±5 s | +0.30 dB | 50, 20 | 50k |"
    assert lines[4] == "| late | +1.00, +.025, -10 s | +1.00 dB | 50, 10 | 50k |"


def test_each_run_of_a_batch_is_a_row() -> None:
    """Skipped stages count as no time; without ground truth the cell is blank."""
    stages = ("decode", "features", "matches", "sfm", "undistort", "train")
    times = {f"{stage}_wall_s": 5.0 for stage in stages} | {
        "decode_wall_s": None,
        "refine_wall_s": None,
    }
    more = {"total_images": 12, "registered_images": 11, "peak_rss_mb": 512.4, "warnings": 2}
    lines = compare.each_run(
        [
            row("a", "fast", 30.0, **times, **more, rotation_error_deg=0.0123),
            row("b", "fast", 20.0, **times, **more, rotation_error_deg=None, train_psnr=None),
            row("c", "fast", 0.0, status="failed", message="no poses"),
        ]
    )
    assert lines[2] == (
        "| a@fast | 30.00 dB | 1.00 | .750 | 50k | 11/12 | 0.012 degrees, 100.00% | 20 | 5 | 30 "
        "| 512 | warned |"
    )
    assert lines[3].startswith("| b@fast | 20.00 dB |  | .500 | 50k | 11/12 |  | 20 |")
    assert lines[4].startswith("| c@fast | failed: no poses |")
    assert {line.count("|") for line in lines} == {lines[0].count("|")}


def test_differences_of_a_second_batch_are_listed(tmp_path: Path) -> None:
    first = [row("a", "fast", 30.0), row("b", "fast", 20.0)]
    second = [row("a", "fast", 30.0, wall_s=33.0), row("b", "fast", 20.5, ssim=0.5)]
    files = []
    for name, rows in (("first", first), ("second", second)):
        files.append(tmp_path / f"{name}.json")
        files[-1].write_text(json.dumps({"runs": rows}))
    told = "\n".join(compare.compare(files))
    assert "| a@fast | the same | 30, 33 | 60, 60 |" in told
    assert "| b@fast | psnr 20.0 and 20.5 | 30, 30 | 60, 60 |" in told
    assert "wall_s, second to first: median 1.05, 1.00 to 1.10" in told


def test_a_file_that_is_no_batch_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "benchmark.json"
    file.write_text("{}")
    assert main(["compare", str(file)]) == 2
    assert f"error: {file}" in capsys.readouterr().err
    file.write_text(json.dumps({"runs": [row("a", "fast", 30.0)]}))
    assert main(["compare", str(file), "--base", "slow"]) == 2
    assert "expected a configuration 'slow', found fast" in capsys.readouterr().err
