"""Records of benchmarks hold their results, name their command, and become tables."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import record_tables
from benchmarks.card.result import CardResult
from benchmarks.judge.truth import Truth
from benchmarks.measured import Record, command_line, measured, write_record
from benchmarks.results import (
    BlocksResult,
    BudgetResult,
    FileResult,
    GeoreferenceResult,
    GpuCountsResult,
    GrowthResult,
    JudgeResult,
    LevelResult,
    LightResult,
    MemoryResult,
    NovelViewResult,
    PageResult,
    PoseResult,
    PrunedResult,
    ScalingResult,
    SerialResult,
    SlurmResult,
    StabilityResult,
    StreamedResult,
    StressResult,
    SurfaceResult,
)
from benchmarks.sfm.summary import Cost, Run
from benchmarks.tables import KINDS, MARKER, RECORDS, pages, rewritten
from pipeline.metrics.pose import PoseError
from pipeline.runtime.errors import UserError

GPU_COUNTS = GpuCountsResult(
    *(200_000, 960, 540, 447_000, 4, 1, 74.0, 0.0, 1.0, 0.1),
    memory_mb={"sh": 500.0, "records": 270.0},
    gflop=3.0,
)
EXAMPLES: dict[str, tuple[Any, str]] = {
    "files": (
        FileResult(
            scene="fox",
            gaussians=20_000,
            sh_degree=3,
            format="sog",
            writer="splatmake",
            size_mb=0.9,
            psnr=46.25,
            cpu_s=1.5,
        ),
        "| fox | 20,000 | 3 | sog | splatmake | 0.90 | 45.0 | 46.2 | 1.5 |",
    ),
    "blocks": (
        BlocksResult(
            run="town@fast",
            seed=1,
            photographs=300,
            pixels="640x420",
            test_views=38,
            blocks=4,
            psnr=(26.0, 27.125),
            ssim=(0.8, 0.85),
            gaussians=(68_000, 90_400),
            training_rss_mb=(850.0, 480.0),
            peak_rss_mb=(850.0, 500.0),
            training_cpu_s=(60.0, 150.0),
            largest_block_cpu_s=41.0,
            seam_gradient=(1.25, 1.3),
        ),
        "| town@fast | 1 | 300 | 38, 640x420 | 1, 4 | 26.00, 27.12 | 0.8000, 0.8500 | 68k, 90k | "
        "850, 480 | 850, 500 | 60, 150 | 41 | 1.250, 1.300 | 1.040 |",
    ),
    "budgets": (
        BudgetResult(
            *("fox", "{}", 0, 4.0, 9000, 30.126, 0.9514, 0.2, 150_000, 4.1, 7.9),
            *(1.25, 2, 1.9, 7, "450x800"),
        ),
        "| fox | 7, 450x800 | 4 | 1 | 30.13 | 0.951 | 0.200 | 150k | 9000 | 4.1, 7.9 | "
        "1.2 | 2 | 1.9 |",
    ),
    "gpu_counts": (
        GPU_COUNTS,
        "| 200k, 960x540 | 447,000 | 1 in 4 steps | 74 | 0 | 770 | 264 | 2.91 | 3.0 |",
    ),
    "gpu_model": (
        GPU_COUNTS,
        "| M2, 10 cores, 100 GB/s, 4 TFLOP/s | 200k, 960x540 | 7.7 | 0.8 | 0.3 | 8.8 |",
    ),
    "card": (
        CardResult("step", "5 Gaussians, 96x64", "measured", "", 3.6, {"step_ms": 2.25}),
        "| step | 5 Gaussians, 96x64 | 4 | step_ms 2.25 |",
    ),
    "scaling": (
        ScalingResult("town", 125, "features", 3, 60.4, 30.6, 210.0, 12.2),
        "| features | 3 | 60 | 20 | 31 | 210 | 12 | - | - |",
    ),
    "serial": (
        SerialResult("9 at 4x3", 2, "bin", 10.0, 5.25, 10.3, 40.0),
        "| 9 at 4x3 | bin | 10.00 | 5.25 | 2 | 1.90 | 10.30 | 1.2% | 0.5% |",
    ),
    "slurm": (
        SlurmResult("demo", 2, blocks=4, jobs=12, wall_s=150.4, busy_s=110.0, blocks_s=70.0),
        "| demo | 2 | 4 | 12 | 150 | 110 | 40 | 70 |",
    ),
    "georeference": (
        GeoreferenceResult("GPS on a line", 0, "right", "georeferenced", (0.01, 0.1, 1.0, 2.0)),
        "| GPS | 1 | 1 | 1 | 0 | 0 | 0 | 0 |",
    ),
    "pose_conventions": (
        PoseResult("fox", "COLMAP text", "axes", "named", "the camera axes look like", 2.5),
        "| fox | 1 | 1 | 0 | 0 | 0 | - |",
    ),
    "novel_views": (
        NovelViewResult("fox", "fox@seed1", "beside", 6, 0.0123, 0.25, 28.125, 0.9),
        "| fox | 6 | beside | 1.23 | 25.00 | fox@seed1 | 28.12 | 0.9000 |",
    ),
    "light": (
        LightResult(
            *("plain", 0, 48, "240x180", 1500, "measured", "none", 9000),
            *(30.0, 29.5, 30.0, None, 61.2),
        ),
        "| plain | 0 | 240x180 | 1500 | none | 30.00 | 29.50 | +0.00 | 30.00 | - | 61 |",
    ),
    "surface": (
        SurfaceResult(
            *(0, "320x240", "both", 0.5, 20_000, 27.0, 3.1, 2.4, 12.34, 0.957, 25.0, 28.91, 1200),
            *(12.0, 40.0, 60.0, 80.0, "town", 0.5),
        ),
        "| both | 20,000 | 3.1 | 2.4 | 12.3 | 95.7 | 50.0 | 25.0 | 28.9 | 1200 | 12 | 40 |",
    ),
    "levels": (
        LevelResult(2, 5000, 6, 4.0, 0.03, 8.0, "160x120", 35.25, 33.5, "320x240", 30.5),
        "| 2 | 5000 | 2.00 | 160x120 | 35.25 | 33.50 | 320x240 | 30.50 |",
    ),
    "page": (
        PageResult("garden", 1_000_000, 12.94, 5, 1.4, 2.5, 1.1, 3.0, 7.25, 8.0),
        "| garden | 1,000,000 | 12.9 | 1.4 | 2.5 | 3.0 | 1.1 | 7.2 | 8.0 |",
    ),
    "pruned": (
        PrunedResult("room", "as published", 900_000, 37, "800x533", 28.794, 0.9036),
        "| room | as published | 37, 800x533 | 900,000 | 1.00 | 28.79 | - | 0.9036 |",
    ),
    "streamed": (
        StreamedResult(
            *("town", 1_000_000, 9, 45.25, "engine", 300_000, 3),
            *(1.5, 2.0, 12.0, 299_000, 450_000),
        ),
        "| town | 1,000,000 | 9 | 45.2 | engine | 300,000 | 1.5 | 2.0 | 12.0 | 299,000 | 450,000 |",
    ),
    "memory": (
        MemoryResult(900_000, 1_000_000, 200, 1600, 1067, 1.5, 700, 5500, 5000),
        "| 1000k | 200, 1600x1067 | 5500 | 5000 | 1.10 |",
    ),
    "sfm": (
        Run(
            *("room", "fast/global/retrieval", True, {"mapping": Cost(2.0, 300.0)}, 8),
            PoseError(
                rotation_median_deg=0.1,
                rotation_mean_deg=0.1,
                centre_median=0.02,
                centre_mean=0.02,
                centre_relative_median=0.004,
                radius=5.0,
                scale=1.0,
                auc={1.0: 0.9, 5.0: 1.0},
                num_common=8,
                num_truth=8,
            ),
        ),
        "| room | **fast/global/retrieval** | - | - | 2.0 | 2.0 | - | 0.1000 | 0.02 | 4.000 | "
        "0.900 | 8 | 300 |",
    ),
    "sfm.growth": (
        GrowthResult("incremental", 50, 12.0, None, 300.0, 50, 0.01, 0.002),
        "| incremental | 50 | 12.0 | - | 300 | 50 | 0.010 | 0.002 |",
    ),
    "judge": (
        JudgeResult(
            *("windows", 0, Truth("failed", 0.4, 10, 20.0, None), "weak", ["few points"], 9, 10),
            *(2, 3.0, {"parallax": 0.01, "focal_off": None}),
        ),
        "| failed | 0 | 1 | 0 |",
    ),
    "stability": (
        StabilityResult("far", "moved", 0, 22.0, 0.8, "posed", 0.01, 6000, "", False, True),
        "| far | moved | 22.00 | +0.010 (posed) | 0.8000 | 6000 |  |",
    ),
    "raster_stress": (
        StressResult("needles", 512, 400, 3, 0, 1.2e-6, 1e-6, 2e-5, 3e-4),
        "| needles | 512 | 400 | 3 | 0 | 1.2e-06 | 1.0e-06 | 2.0e-05 | 3.0e-04 |",
    ),
}


@pytest.mark.parametrize("benchmark", EXAMPLES)
def test_a_record_is_read_as_it_was_written_and_becomes_a_table(
    benchmark: str, tmp_path: Path
) -> None:
    result, row = EXAMPLES[benchmark]
    facts = measured(benchmark, "a note", ["--json", "a.json"])
    write_record(tmp_path / "a.json", facts, [result])
    record = json.loads((tmp_path / "a.json").read_text())
    read = Record[record_tables.TABLES[benchmark][0]].model_validate(record)
    assert read.results == [result]
    assert {name: getattr(read, name) for name in type(facts).model_fields} == facts.model_dump()
    lines = record_tables.table_of(benchmark, [record]).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert row in lines


def test_a_record_says_what_was_measured_on() -> None:
    facts = measured("blocks", "alone", ["results"])
    assert facts.command == "python -m benchmarks.blocks results --json FILE"
    assert facts.note == "alone" and facts.date and facts.processor
    assert facts.compiler and facts.instruction_set


def test_the_command_has_neither_the_note_nor_the_name_of_the_file() -> None:
    arguments = ["posed", "--json", "out/a.json", "--note=x y", "--work", "a b"]
    assert command_line("stability", arguments) == (
        "python -m benchmarks.stability posed --work 'a b' --json FILE"
    )


def test_a_record_with_other_fields_is_refused() -> None:
    record = measured("slurm", "", []).model_dump() | {"results": [{"scene": "a"}]}
    with pytest.raises(UserError, match=r"results\.0\.nodes.*\n.*run its command again"):
        record_tables.table_of("slurm", [record])


def test_a_missing_record_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("benchmarks.tables.RECORDS", tmp_path)
    with pytest.raises(UserError, match=r"none\.json: expected a record"):
        rewritten("<!-- blocks: none.json -->\n")


def test_every_table_is_of_a_benchmark() -> None:
    assert set(record_tables.TABLES) - {"budget-curves", "serial_forecast"} == set(EXAMPLES)
    for benchmark in EXAMPLES:
        assert benchmark in KINDS
        assert importlib.util.find_spec(f"benchmarks.{benchmark}") is not None


STORED = [
    (path.name, record["benchmark"])
    for path in sorted(RECORDS.glob("*.json"))
    if (record := json.loads(path.read_text())).get("benchmark") in record_tables.TABLES
]


@pytest.mark.parametrize(("name", "benchmark"), STORED)
def test_a_stored_record_has_its_table_and_its_command_on_a_page(name: str, benchmark: str) -> None:
    record = json.loads((RECORDS / name).read_text())
    assert record_tables.table_of(benchmark, [record]).count("\n") > 2
    shown = {
        kind
        for page in pages()
        for kind, names in MARKER.findall(page.read_text())
        if name in names.split()
    }
    assert shown >= {benchmark, "sources"}
