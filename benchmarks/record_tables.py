"""Tables of the benchmarks' records, for ``benchmarks.tables`` and the benchmarks' own output."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from benchmarks import gpu_model, markdown
from benchmarks.budgets import tables as budget_tables
from benchmarks.card import result as card
from benchmarks.judge.truth import Grade
from benchmarks.markdown import cell
from benchmarks.measured import Record
from benchmarks.results import (
    GEOREFERENCE_VERDICTS,
    STEP,
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
    PoseOutcome,
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
from benchmarks.sfm import summary
from pipeline.runtime.errors import UserError

GRADES: tuple[Grade, ...] = ("good", "weak", "failed")
GROWTH_HEADING = [
    *("mapper", "views", "CPU s", "grows as N^", "MiB", "images", "rotation, deg", "centre, m"),
]
# The number of photographs for which growth is extrapolated.
EXTRAPOLATED = 100_000
Stored = Mapping[str, Any]
"""A record as read from JSON."""


def memory(found: Sequence[MemoryResult]) -> str:
    rows = [["Gaussians", "views, pixels", "planned (MB)", "peak (MB)", "planned / peak"]]
    for r in found:
        rows.append(
            [
                f"{r.most_gaussians / 1e3:.0f}k",
                f"{r.views}, {r.width}x{r.height}",
                f"{r.planned_mb}",
                f"{r.peak_mb}",
                f"{r.planned_mb / r.peak_mb:.2f}",
            ]
        )
    return markdown.table(rows)


def novel_views(found: Sequence[NovelViewResult]) -> str:
    rows = [
        [
            *("run", "novel views", "kind", "contradicted (%)", "in no photograph (%)"),
            *("against", "PSNR (dB)", "SSIM"),
        ]
    ]
    for r in found:
        shares = (f"{100 * share:.2f}" for share in (r.contradicted_share, r.unseen_share))
        agreement = (cell(r.psnr, ".2f"), cell(r.ssim, ".4f"))
        rows.append([r.run, str(r.views), r.kind, *shares, r.against or "-", *agreement])
    return markdown.table(rows)


def light(found: Sequence[LightResult]) -> str:
    """One row for each run; differences are from the plain world's run of the same setup."""
    rows = [
        [
            *("world", "seed", "pixels", "steps", "appearance", "PSNR (dB)", "right half (dB)"),
            *("from plain (dB)", "without gains or fit (dB)", "withheld (dB)", "time (s)"),
        ]
    ]
    plain = {
        (r.seed, r.pixels, r.views, r.steps): r.psnr_right for r in found if r.world == "plain"
    }
    for r in found:
        reference = plain.get((r.seed, r.pixels, r.views, r.steps))
        difference = None if reference is None else r.psnr_right - reference
        chosen = r.chosen if r.option == "measured" else f"{r.chosen} (given)"
        values = (f"{r.psnr:.2f}", f"{r.psnr_right:.2f}", cell(difference, "+.2f"))
        others = (f"{r.psnr_own:.2f}", cell(r.psnr_withheld, ".2f"), f"{r.seconds:.0f}")
        rows.append([r.world, str(r.seed), r.pixels, str(r.steps), chosen, *values, *others])
    return markdown.table(rows)


def surface(found: Sequence[SurfaceResult]) -> str:
    """One row for each mesh."""
    rows = [
        [
            *("depths", "triangles", "vertices off (mm)", "surface off (mm)", "90 % within (mm)"),
            *("complete (%)", "thin parts (%)", "vertex colours (dB)", "texture (dB)"),
            "texture (px)",
            *("mesh (s)", "texture (s)"),
        ]
    ]
    for r in found:
        errors = (f"{value:.1f}" for value in (r.vertex_error_mm, r.error_mm, r.p90_mm))
        colours = (f"{r.psnr_vertices:.1f}", cell(r.psnr_texture, ".1f"), str(r.texture_px or "-"))
        times = (f"{r.mesh_s:.0f}", cell(r.texture_s, ".0f"))
        thin = None if r.thin_completeness is None else 100 * r.thin_completeness
        complete = (f"{100 * r.completeness:.1f}", cell(thin, ".1f"))
        rows.append([r.depths, f"{r.triangles:,}", *errors, *complete, *colours, *times])
    return markdown.table(rows)


def levels(found: Sequence[LevelResult]) -> str:
    """One row for each level; distances in median depths of the test views."""
    rows = [
        [
            *("level", "Gaussians", "distance of a pixel (median depths)", "pixels there"),
            *("PSNR there (dB)", "against averaged pixels (dB)"),
            *("pixels of the views", "PSNR in the views (dB)"),
        ]
    ]
    for r in found:
        far = (f"{r.distance / r.depth:.2f}", r.pixels, cell(r.psnr, ".2f"))
        near = (f"{r.psnr_averaged:.2f}", r.near_pixels, cell(r.psnr_near, ".2f"))
        rows.append([str(r.level), str(r.gaussians), *far, *near])
    return markdown.table(rows)


def page_table(found: Sequence[PageResult]) -> str:
    rows = [
        [
            *("page", "Gaussians", "page (MB)", "arrived (s)", "first picture (s)", "slowest (s)"),
            *("after arrival (s)", "own Gaussians (s)", "frames per second"),
        ]
    ]
    for r in found:
        count = "-" if r.gaussians is None else f"{r.gaussians:,}"
        times = (r.arrived_s, r.first_s, r.slowest_first_s, r.first_after_arrival_s, r.own_s)
        seconds = (f"{value:.1f}" for value in times)
        rows.append([r.page, count, f"{r.page_mb:.1f}", *seconds, f"{r.frames_per_s:.1f}"])
    return markdown.table(rows)


def pruned_table(found: Sequence[PrunedResult]) -> str:
    """A row for each file. Changes are against the first file of the same scene and training."""
    rows = [
        [
            *("scene", "training", "test views, pixels", "Gaussians", "share"),
            *("PSNR (dB)", "change (dB)", "SSIM"),
        ]
    ]
    whole: dict[tuple[str, str], PrunedResult] = {}
    for r in found:
        all_ = whole.setdefault((r.scene, r.training), r)
        share, change = r.gaussians / all_.gaussians, r.psnr - all_.psnr
        size = (f"{r.views}, {r.pixels}", f"{r.gaussians:,}", f"{share:.2f}")
        changed = "-" if r is all_ else f"{change:+.2f}"
        rows.append([r.scene, r.training, *size, f"{r.psnr:.2f}", changed, f"{r.ssim:.4f}"])
    return markdown.table(rows)


def streamed_table(found: Sequence[StreamedResult]) -> str:
    rows = [
        [
            *("scene", "Gaussians", "files", "size (MB)", "engine", "budget", "first picture (s)"),
            *("slowest (s)", "complete (s)", "most drawn", "most in memory"),
        ]
    ]
    for r in found:
        numbers = (f"{r.gaussians:,}", str(r.files), f"{r.file_mb:.1f}", r.engine, f"{r.budget:,}")
        times = (r.first_s, r.slowest_first_s, r.complete_s)
        most = (f"{r.most_drawn:,}", f"{r.most_resident:,}")
        rows.append([r.scene, *numbers, *(f"{value:.1f}" for value in times), *most])
    return markdown.table(rows)


def growth(found: Sequence[GrowthResult]) -> str:
    return markdown.table([GROWTH_HEADING, *map(growth_row, found)])


def growth_row(result: GrowthResult) -> list[str]:
    return [
        result.mapper,
        f"{result.views}",
        f"{result.cpu_s:.1f}",
        cell(result.power, ".2f"),
        f"{result.peak_mb:.0f}",
        f"{result.registered}",
        cell(result.rotation_deg, ".3f"),
        cell(result.centre_m, ".3f"),
    ]


def verdicts(found: Sequence[JudgeResult]) -> str:
    """The confusion table of true grades and verdicts."""
    counts = Counter((row.truth.grade, row.verdict) for row in found if row.truth is not None)
    rows = [["truth", *(f"called {grade}" for grade in GRADES)]]
    rows += [[true, *(str(counts[true, called]) for called in GRADES)] for true in GRADES]
    return markdown.table(rows)


def outcomes(found: Sequence[StabilityResult]) -> str:
    rows = [["case", "what", "PSNR (dB)", "against", "SSIM", "Gaussians", ""]]
    for r in found:
        against = ""
        if r.difference_db is not None:
            against = f"{r.difference_db:+.3f} ({r.reference})"
        rows.append(
            [
                r.case if r.right else f"{r.case} **WRONG**",
                r.what,
                "error" if r.psnr is None else f"{r.psnr:.2f}",
                against,
                "" if r.ssim is None else f"{r.ssim:.4f}",
                "" if r.gaussians is None else str(r.gaussians),
                textwrap.shorten(r.message, 200, placeholder=" ..."),
            ]
        )
    return markdown.table(rows)


def raster_stress(found: Sequence[StressResult]) -> str:
    rows = [
        [
            *("family", "cases", "drawn", "dropped", "not finite", "colour error"),
            *("gradient error: median", "99 %", "worst"),
        ]
    ]
    for r in found:
        counts = (r.cases, r.drawn, r.dropped, r.not_finite)
        errors = (r.colour, r.gradient_median, r.gradient_p99, r.gradient_worst)
        rows.append([r.family, *map(str, counts), *(f"{error:.1e}" for error in errors)])
    return markdown.table(rows)


def blocks(found: Sequence[BlocksResult]) -> str:
    rows = [
        [
            *("run", "seed", "photographs", "test views, pixels", "blocks", "PSNR (dB)", "SSIM"),
            *(
                "Gaussians",
                "memory (MB): training",
                "any job",
                "CPU s of training",
                "largest block",
            ),
            *("gradient of the error at seams", "ratio"),
        ]
    ]
    for r in found:
        rows.append(
            [
                *(r.run, cell(r.seed, "d"), str(r.photographs)),
                *(f"{r.test_views}, {r.pixels}", f"1, {r.blocks}"),
                *(_pair(r.psnr, ".2f"), _pair(r.ssim, ".4f")),
                ", ".join(f"{value / 1000:.0f}k" for value in r.gaussians),
                *(_pair(r.training_rss_mb, ".0f"), _pair(r.peak_rss_mb, ".0f")),
                *(_pair(r.training_cpu_s, ".0f"), f"{r.largest_block_cpu_s:.0f}"),
                *(_pair(r.seam_gradient, ".3f"), f"{r.seams:.3f}"),
            ]
        )
    return markdown.table(rows)


def _pair(values: Sequence[float], form: str) -> str:
    return ", ".join(format(value, form) for value in values)


def scaling_table(found: Sequence[ScalingResult]) -> str:
    """A row for each stage: each run in a group of columns, the growth of the CPU time, and the CPU
    time of ``EXTRAPOLATED`` photographs if it goes on like that."""
    runs = list(dict.fromkeys(r.run for r in found))
    by_key = {(r.stage, r.run): r for r in found}
    heading = ["stage"]
    for run in runs:
        count = next(r.photographs for r in found if r.run == run)
        heading += [f"{count} photographs: jobs", "CPU s", "a job", "largest", "MB", "files, MB"]
    rows = [[*heading, "CPU grows as N^", f"{EXTRAPOLATED:,} photographs: CPU h".replace(",", " ")]]
    for stage in dict.fromkeys(r.stage for r in found):
        of_runs = [by_key.get((stage, run)) for run in runs]
        row = [stage]
        for r in of_runs:
            row += (
                ["-"] * 6
                if r is None
                else [
                    *(str(r.jobs), f"{r.cpu_s:.0f}", f"{r.cpu_s / r.jobs:.0f}"),
                    f"{r.largest_cpu_s:.0f}",
                    *(f"{r.peak_rss_mb:.0f}", f"{r.output_mb:.0f}"),
                ]
            )
        few, many = of_runs[0], of_runs[-1]
        power = hours = None
        if few is not None and many is not None and many.photographs != few.photographs:
            power = math.log(many.cpu_s / few.cpu_s)
            power /= math.log(many.photographs / few.photographs)
            hours = many.cpu_s * (EXTRAPOLATED / many.photographs) ** power / 3600
        rows.append([*row, cell(power, ".2f"), cell(hours, ".0f")])
    return markdown.table(rows)


def poses_table(found: Sequence[PoseResult]) -> str:
    """A row for each scene: the outcomes of its mistakes, and of its right poses."""
    rows = [["scene", "mistakes", "named", "refused otherwise", "warned", "silent", "right poses"]]
    for scene in dict.fromkeys(r.scene for r in found):
        wrong = [r.outcome for r in found if r.scene == scene and r.mistake]
        right = [r.outcome for r in found if r.scene == scene and not r.mistake]
        kinds: tuple[PoseOutcome, ...] = ("named", "refused", "warned", "silent")
        counts = [str(wrong.count(kind)) if wrong else "-" for kind in kinds]
        of_right = ", ".join(f"{right.count(o)} {o}" for o in dict.fromkeys(right)) or "-"
        rows.append([scene, str(len(wrong)) if wrong else "-", *counts, of_right])
    return markdown.table(rows)


def verdicts_table(found: Sequence[GeoreferenceResult]) -> str:
    """A row for each source of a world frame: the verdicts on its cases."""
    rows = [["measured by", "cases", "surveys", *GEOREFERENCE_VERDICTS]]
    for source in ("GPS", "ground control points"):
        own = [r for r in found if r.case.startswith("GPS") == (source == "GPS")]
        counts = [sum(r.verdict == verdict for r in own) for verdict in GEOREFERENCE_VERDICTS]
        rows.append([source, str(len({r.case for r in own})), str(len(own)), *map(str, counts)])
    return markdown.table(rows)


def files_table(found: Sequence[FileResult]) -> str:
    """A row for each file; sizes are also those of a Gaussian."""
    rows = [["scene", "Gaussians", "SH degree", "format", "written by"]]
    rows[0] += ["size (MB)", "bytes a Gaussian", "against PLY (dB)", "CPU (s)"]
    for r in found:
        counts = [f"{r.gaussians:,}", str(r.sh_degree)]
        sizes = [f"{r.size_mb:.2f}", f"{1e6 * r.size_mb / r.gaussians:.1f}"]
        loss = "equal" if r.psnr >= 100 else f"{r.psnr:.1f}"
        rows.append([r.scene, *counts, r.format, r.writer, *sizes, loss, cell(r.cpu_s, ".1f")])
    return markdown.table(rows)


def slurm_table(found: Sequence[SlurmResult]) -> str:
    rows = [["scene", "nodes", "blocks", "jobs"]]
    rows[0] += ["wall (s)", "a job runs (s)", "none runs (s)", "training of blocks (s)"]
    for r in found:
        times = (r.wall_s, r.busy_s, r.wall_s - r.busy_s)
        counts = (r.nodes, r.blocks, r.jobs)
        seconds = (*(f"{value:.0f}" for value in times), cell(r.blocks_s, ".0f"))
        rows.append([r.scene, *map(str, counts), *seconds])
    return markdown.table(rows)


def serial_table(found: Sequence[SerialResult]) -> str:
    """The times of each phase, and the serial part by Amdahl's law."""
    rows = [
        [
            *("Gaussians", "phase", "1 thread (ms)", "n threads (ms)", "n", "speed-up"),
            *(
                "all n threads without waits (ms)",
                "serial part",
                "serial part without memory traffic",
            ),
        ]
    ]
    for r in found:
        times = (f"{r.one_ms:.2f}", f"{r.many_ms:.2f}", str(r.threads))
        speed_up = f"{r.one_ms / r.many_ms:.2f}" if r.many_ms else ""
        shares = (f"{r.share:.1%}", f"{r.waiting_share:.1%}")
        rows.append([r.scene, r.phase, *times, speed_up, f"{r.busy_ms:.2f}", *shares])
    return markdown.table(rows)


def forecast_table(found: Sequence[SerialResult]) -> str:
    """The speed-up of a step on more cores by Amdahl's law."""
    cores = (4, 16, 64)
    rows = [["Gaussians", "serial part", "of the step", *(f"{n} cores" for n in cores)]]
    for r in found:
        if r.phase != STEP:
            continue
        for name, share in (("of all", r.share), ("without memory traffic", r.waiting_share)):
            serial = max(0.0, share)
            speed_ups = (f"{1 / (serial + (1 - serial) / n):.1f}" for n in cores)
            rows.append([r.scene, name, f"{share:.1%}", *speed_ups])
    return markdown.table(rows)


#: Kind of table -> the type of the results in its records, and the function that makes the table.
TABLES: dict[str, tuple[type[Any], Callable[[Sequence[Any]], str]]] = {
    "card": (card.CardResult, card.table),
    "gpu_counts": (GpuCountsResult, gpu_model.counts_table),
    "gpu_model": (GpuCountsResult, gpu_model.model_table),
    "memory": (MemoryResult, memory),
    "sfm": (summary.Run, lambda found: summary.table(summary.summaries(found))),
    "sfm.growth": (GrowthResult, growth),
    "judge": (JudgeResult, verdicts),
    "stability": (StabilityResult, outcomes),
    "raster_stress": (StressResult, raster_stress),
    "blocks": (BlocksResult, blocks),
    "budgets": (BudgetResult, budget_tables.table),
    "budget-curves": (BudgetResult, budget_tables.curves),
    "novel_views": (NovelViewResult, novel_views),
    "light": (LightResult, light),
    "surface": (SurfaceResult, surface),
    "levels": (LevelResult, levels),
    "page": (PageResult, page_table),
    "pruned": (PrunedResult, pruned_table),
    "streamed": (StreamedResult, streamed_table),
    "georeference": (GeoreferenceResult, verdicts_table),
    "pose_conventions": (PoseResult, poses_table),
    "scaling": (ScalingResult, scaling_table),
    "serial": (SerialResult, serial_table),
    "serial_forecast": (SerialResult, forecast_table),
    "slurm": (SlurmResult, slurm_table),
    "files": (FileResult, files_table),
}


def table_of(kind: str, records: Sequence[Stored]) -> str:
    """The table of a kind, of the results of all records.

    Raises:
        UserError: A record has other fields.
    """
    of_result, made = TABLES[kind]
    found: list[Any] = []
    for record in records:
        try:
            found += Record[of_result].model_validate(record).results  # type: ignore[valid-type]
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(map(str, first["loc"]))
            raise UserError(
                f"the record of `{record.get('command')}` is not this version's: "
                f"{field}: {first['msg']}",
                fix="run its command again",
            ) from error
    return made(found)
