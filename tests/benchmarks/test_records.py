"""Records of benchmarks hold their results, name their command, and become tables."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import record_tables
from benchmarks.judge.truth import Truth
from benchmarks.measured import Record, command_line, measured, write_record
from benchmarks.results import (
    Accuracy,
    BlocksResult,
    BudgetResult,
    CoverageResult,
    DenseResult,
    GeoreferenceResult,
    GrowthResult,
    JudgeResult,
    MemoryResult,
    MeshResult,
    PageResult,
    PoseResult,
    ScalingResult,
    SlurmResult,
    StabilityResult,
    StressResult,
    VideoFrames,
    WideResult,
)
from benchmarks.sfm.summary import Cost, Run
from benchmarks.tables import KINDS, MARKER, RECORDS, pages, rewritten
from pipeline.metrics.pose import PoseError
from pipeline.runtime.errors import UserError

BOTH = {"test": 30.0, "removed": 20.0}
EXAMPLES: dict[str, tuple[Any, Any, str]] = {
    "blocks": (
        Record[BlocksResult],
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
        Record[BudgetResult],
        BudgetResult(
            *("fox", "splatmake", "{}", 0, 4.0, 9000, 30.126, 0.9514, 0.2, 150_000, 4.1, 7.9),
            *(1.25, 2, 1.9, 7, "450x800", None, None, []),
        ),
        "| fox | splatmake | 7, 450x800 | 4 | 1 | 30.13 | 0.951 | 0.200 | 150k | 9000 | 4.1, 7.9 | "
        "1.2 | 2 | 1.9 |",
    ),
    "scaling": (
        Record[ScalingResult],
        ScalingResult("town", 125, "features", 3, 60.4, 30.6, 210.0, 12.2),
        "| features | 3 | 60 | 20 | 31 | 210 | 12 | - | - |",
    ),
    "slurm": (
        Record[SlurmResult],
        SlurmResult("demo", 2, blocks=4, jobs=12, wall_s=150.4, busy_s=110.0, blocks_s=70.0),
        "| demo | 2 | 4 | 12 | 150 | 110 | 40 | 70 |",
    ),
    "video": (
        Record[VideoFrames],
        VideoFrames("walk.mp4", 900, 60, 120.4, 100.0),
        "| walk.mp4 | 900 | 60 | 120 | 100 | 1.20 |",
    ),
    "wide": (
        Record[WideResult],
        WideResult("fisheye", "720x720", 24, 23, 115, 0.01, 0.02, 1e-4, 33.5, 0.95, 0.987),
        "| fisheye | 720x720 | 24 | 23 | 115 | 98.7% | 0.0100, 0.0200 | 0.010% | 33.50 | 0.9500 |",
    ),
    "georeference": (
        Record[GeoreferenceResult],
        GeoreferenceResult("GPS on a line", 0, "right", "georeferenced", (0.01, 0.1, 1.0, 2.0)),
        "| GPS | 1 | 1 | 1 | 0 | 0 | 0 | 0 |",
    ),
    "pose_conventions": (
        Record[PoseResult],
        PoseResult("fox", "COLMAP text", "axes", "named", "the camera axes look like", 2.5),
        "| fox | 1 | 1 | 0 | 0 | 0 | - |",
    ),
    "mesh": (
        Record[MeshResult],
        MeshResult(
            *(90_000, 0.02, 512, {"wall": 2.0, "cpu": 3.0}, 500.0),
            foreground=Accuracy(2.5, 0.001, 0.004, 0.95),
            room=Accuracy(10.0, 0.002, 0.01, 0.9),
        ),
        "| foreground | 2.5 | 20.0 | 90k | 2.5 | 10.0 | 95.0% |",
    ),
    "dense": (
        Record[DenseResult],
        DenseResult(
            *("town", 40, "640x427", 0.0004, [0.8, 0.85, 0.9], 0.92, [0.9, 0.95, 0.99]),
            *(1_930_000, "x86-64-v3", 1.8, 500.0),
        ),
        "| town | 40, 640x427 | 0.040% | 80.0%, 85.0%, 90.0% | 92.0% | 90.0%, 95.0%, 99.0% "
        "| 1.93M | 1.80 | x86-64-v3 | 500 |",
    ),
    "coverage": (
        Record[CoverageResult],
        CoverageResult(
            *("two", 20, {"test": 0.8, "removed": 0.3}, BOTH, -0.6, [0.4, 9.0], [0.2, 5.0]),
            *([1.2, 30.0], [0.9, 20.0], 0.97, {"test": 0.1, "removed": 1.5}),
            added_random=[{"test": 0.0, "removed": gain} for gain in (0.2, 0.4, 0.9)],
            surroundings=[0.3, 0.5, 40],
        ),
        "| two | 0.80, 0.30 | 30.00, 20.00 | -0.60 | 0.40, 1.20 | 97% | +1.50, +0.40 |",
    ),
    "memory": (
        Record[MemoryResult],
        MemoryResult(900_000, 1_000_000, 200, 1600, 1067, 1.5, 700, 5500, 5000),
        "| 1000k | 200, 1600x1067 | 5500 | 5000 | 1.10 |",
    ),
    "sfm": (
        Record[Run],
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
        Record[GrowthResult],
        GrowthResult("incremental", 50, 12.0, None, 300.0, 50, 0.01, 0.002),
        "| incremental | 50 | 12.0 | - | 300 | 50 | 0.010 | 0.002 |",
    ),
    "judge": (
        Record[JudgeResult],
        JudgeResult(
            *("windows", 0, Truth("failed", 0.4, 10, 20.0, None), "weak", ["few points"], 9, 10),
            *(2, 3.0, {"parallax": 0.01, "focal_off": None}),
        ),
        "| failed | 0 | 1 | 0 |",
    ),
    "stability": (
        Record[StabilityResult],
        StabilityResult("far", "moved", 0, 22.0, 0.8, "posed", 0.01, 6000, "", False, True),
        "| far | moved | 22.00 | +0.010 (posed) | 0.8000 | 6000 |  |",
    ),
    "page": (
        Record[PageResult],
        PageResult("the PLY", "view_0.png", 45.678),
        "| the PLY | view_0.png | 45.68 |",
    ),
    "raster_stress": (
        Record[StressResult],
        StressResult("needles", 512, 400, 3, 0, 1.2e-6, 1e-6, 2e-5, 3e-4),
        "| needles | 512 | 400 | 3 | 0 | 1.2e-06 | 1.0e-06 | 2.0e-05 | 3.0e-04 |",
    ),
}


@pytest.mark.parametrize("benchmark", record_tables.TABLES)
def test_a_record_is_read_as_it_was_written_and_becomes_a_table(
    benchmark: str, tmp_path: Path
) -> None:
    kind, result, row = EXAMPLES[benchmark]
    facts = measured(benchmark, "a note", ["--json", "a.json"])
    write_record(tmp_path / "a.json", facts, [result])
    record = json.loads((tmp_path / "a.json").read_text())
    read = kind.model_validate(record)
    assert read.results == [result]
    assert {name: getattr(read, name) for name in type(facts).model_fields} == facts.model_dump()
    lines = record_tables.TABLES[benchmark]([record]).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert row in lines


def test_a_record_says_what_was_measured_on() -> None:
    facts = measured("page", "alone", ["results/demo"])
    assert facts.command == "python -m benchmarks.page results/demo --json FILE"
    assert facts.note == "alone" and facts.date and facts.processor
    assert facts.compiler and facts.instruction_set


def test_the_command_has_neither_the_note_nor_the_name_of_the_file() -> None:
    arguments = ["posed", "--json", "out/a.json", "--note=x y", "--work", "a b"]
    assert command_line("stability", arguments) == (
        "python -m benchmarks.stability posed --work 'a b' --json FILE"
    )


def test_a_record_with_other_fields_is_refused() -> None:
    record = measured("page", "", []).model_dump() | {"results": [{"file": "a", "view": "b"}]}
    with pytest.raises(UserError, match=r"results\.0\.psnr.*\n.*run its command again"):
        record_tables.page([record])


def test_a_missing_record_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("benchmarks.tables.RECORDS", tmp_path)
    with pytest.raises(UserError, match=r"none\.json: expected a record"):
        rewritten("<!-- mesh: none.json -->\n")


def test_every_table_is_of_a_benchmark() -> None:
    assert set(record_tables.TABLES) == set(EXAMPLES)
    for benchmark in record_tables.TABLES:
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
    assert record_tables.TABLES[benchmark]([record]).count("\n") > 2
    shown = {
        kind
        for page in pages()
        for kind, names in MARKER.findall(page.read_text())
        if name in names.split()
    }
    assert shown >= {benchmark, "sources"}
