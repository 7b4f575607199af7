"""Constructed results of scenes, and a command line that judges them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.command.main import main
from pipeline.export.counters import FileLoss
from pipeline.reporting.metrics import Metrics
from pipeline.runtime.atomic import write_json, write_text
from pipeline.runtime.record import RunRecord
from pipeline.scene.georeference import GeoreferenceSummary, ResidualSummary
from tests.reporting.made import coverage, metrics

SPZ = FileLoss(file="point_cloud.spz", size_mb=1.2, psnr=55.0)
GOOD = {"psnr": 28.0, "ssim": 0.9, "train_psnr": 30.0, "warnings": [], "exported": [SPZ]}
PLACED = GeoreferenceSummary(
    method="gps",
    origin=None,
    residuals_m=ResidualSummary(
        used=9,
        left_out=0,
        observations=27,
        freedoms=20,
        horizontal_median=0.8,
        horizontal_max=1.5,
        vertical_median=None,
        vertical_max=None,
    ),
).model_dump()


def write_result(
    folder: Path,
    *,
    minutes: float = 2.0,
    memory_mb: float = 1000.0,
    contradicted: float = 0.03,
    seen: float = 0.9,
    **changes: Any,
) -> Path:
    """A finished scene's records: a good result, with changes of its metrics."""
    found = metrics(**(GOOD | changes)).model_dump(mode="json")
    for stage in found["stages"].values():
        for name in ("wall_s", "cpu_s", "peak_rss_mb"):
            del stage[name]
    Metrics.model_validate(found).write(folder / "report")
    record = coverage().record
    seen_by = record.surface.seen_by.model_copy(update={"three_or_more": seen})
    record.model_copy(
        update={
            "surface": record.surface.model_copy(update={"seen_by": seen_by}),
            "novel_views": record.novel_views.model_copy(
                update={"contradicted_share": contradicted}
            ),
        }
    ).write(folder / "coverage")
    for name in ("inspect", "train"):
        run = RunRecord(
            wall_s=30 * minutes,
            cpu_s=1.0,
            peak_rss_mb=memory_mb,
            threads=2,
            seed=0,
            versions={},
            commit=None,
            finished="2026-01-01T00:00:00",
        )
        write_json(folder / name / "run.json", run.model_dump(mode="json"))
    return folder


def accept(scene: Path, rules: str | None = None, *more: str | Path) -> int:
    """The exit code of ``splatmake accept``, for a file with ``rules`` if any are given."""
    words = ["accept", scene, *more]
    if rules is not None:
        file = scene.parent / "rules.yaml"
        write_text(file, rules)
        words += ["--rules", file]
    return main([str(word) for word in words])
