"""The docs state what the records hold, and nothing measured besides."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.record import NotComparable, scene_record
from benchmarks.tables import KINDS, RECORDS, ROOT, figures_outside, pages, rewritten

PAGES = [str(page.relative_to(ROOT)) for page in pages()]


@pytest.mark.parametrize("page", PAGES)
def test_pages_state_what_their_records_hold(page: str) -> None:
    text = (ROOT / page).read_text()
    assert rewritten(text) == text, "run python -m benchmarks.tables"
    assert not re.search(r"^\|[^\n]*\n[^|\n]", text, re.M), "a table without a line after it"


@pytest.mark.parametrize("page", PAGES)
def test_every_measured_figure_comes_from_a_record(page: str) -> None:
    assert figures_outside((ROOT / page).read_text()) == []


def test_every_record_is_shown_and_says_how_to_repeat_it() -> None:
    text = "\n".join(page.read_text() for page in pages())
    for path in sorted(RECORDS.glob("*.json")):
        record = json.loads(path.read_text())
        assert path.name in text, f"{path.name}: on no page"
        for key in ("command", "commit", "compiler"):
            assert record.get(key), f"{path.name}: {key} is missing"
        assert {"instruction_set", "target"} & record.keys(), path.name


def test_a_changed_record_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record: dict[str, Any] = {"figures": {"time": "3 s"}}
    (tmp_path / "a.json").write_text(json.dumps(record))
    monkeypatch.setattr("benchmarks.tables.RECORDS", tmp_path)
    page = "It takes <!-- figure: a.json time -->2 s<!-- end -->.\n"
    assert "3 s" in rewritten(page) and "2 s" not in rewritten(page)
    assert figures_outside("at 31.2 dB") == ["31.2 dB"]


def _finished(folder: Path, seed: int, psnr: float, commit: str = "abc") -> Path:
    metrics: dict[str, Any] = {
        "scene": f"room@fast@seed{seed}", "seed": seed, "psnr": psnr, "ssim": 0.9, "lpips": None,
        "train_psnr": 33.0, "num_gaussians": 10_000, "registered_images": 12, "total_images": 12,
        "pose_error": {"rotation_median_deg": 0.02, "centre_relative_median": 1e-3, "auc": {}},
        "protocol": {
            "num_views": 2, "resolution": ["64x48"], "split": "every 8th", "background": [0, 0, 0],
            "exposure": None, "masks": None, "poses": None,
        },
    }  # fmt: skip
    run = {
        "commit": commit, "processor": "P", "cores": 2, "memory_mb": 8000, "threads": 2,
        "instruction_set": "x86-64-v3", "compiler": "g++", "load_average": 1.0, "cpu_s": 60.0,
        "wall_s": 30.0, "peak_rss_mb": 500.0,
    }  # fmt: skip
    (folder / "train").mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "train" / "run.json").write_text(json.dumps(run))
    return folder


def test_a_record_holds_the_spread_over_seeds(tmp_path: Path) -> None:
    folders = [_finished(tmp_path / str(seed), seed, 30.0 + seed) for seed in (2, 0, 1)]
    record = scene_record(folders, "snakemake ...")
    assert [run["seed"] for run in record["runs"]] == [0, 1, 2]
    row = KINDS["scenes"]([record]).splitlines()[2]
    assert "| room |" in row and "31.00 ±1.00" in row and "0.020°, 0.10%" in row


def test_runs_of_different_commits_are_refused(tmp_path: Path) -> None:
    folders = [_finished(tmp_path / c, i, 30.0, commit=c) for i, c in enumerate(("abc", "def"))]
    with pytest.raises(NotComparable, match="where differs"):
        scene_record(folders, "snakemake ...")
