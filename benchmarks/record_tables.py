"""Tables of the benchmarks' records, for ``benchmarks.tables`` and the benchmarks' own output."""

from __future__ import annotations

import math
import statistics
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from benchmarks import markdown
from benchmarks.budgets import tables as budget_tables
from benchmarks.judge.truth import Grade
from benchmarks.markdown import cell
from benchmarks.measured import Record, Result
from benchmarks.results import (
    GEOREFERENCE_VERDICTS,
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
    PoseOutcome,
    PoseResult,
    ScalingResult,
    SlurmResult,
    StabilityResult,
    StressResult,
    VideoFrames,
    WideResult,
)
from benchmarks.sfm import summary
from pipeline.runtime.errors import UserError

GRADES: tuple[Grade, ...] = ("good", "weak", "failed")
GROWTH_HEADING = [
    *("mapper", "views", "CPU s", "grows as N^", "MiB", "images", "rotation, deg", "centre, m"),
]
# Number of photographs for which growth is extrapolated.
EXTRAPOLATED = 100_000
Stored = Mapping[str, Any]
"""A record as read from JSON."""


def results(records: Sequence[Stored], kind: type[Record[Result]]) -> list[Result]:
    """The results of all records.

    Raises:
        UserError: a record has other fields.
    """
    found: list[Result] = []
    for record in records:
        try:
            found += kind.model_validate(record).results
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(map(str, first["loc"]))
            raise UserError(
                f"the record of `{record.get('command')}` is not this version's: "
                f"{field}: {first['msg']}",
                fix="run its command again",
            ) from error
    return found


def mesh(records: Sequence[Stored]) -> str:
    rows = [
        [
            *("region", "size (m)", "voxel (mm)", "triangles", "median distance (mm)"),
            *("90th percentile (mm)", "completeness"),
        ]
    ]
    for result in results(records, Record[MeshResult]):
        for name, region in (("foreground", result.foreground), ("room", result.room)):
            rows.append(
                [
                    name,
                    f"{region.size:.1f}",
                    f"{1e3 * result.voxel_m:.1f}",
                    f"{result.triangles / 1e3:.0f}k",
                    f"{1e3 * region.size * region.median:.1f}",
                    f"{1e3 * region.size * region.p90:.1f}",
                    f"{region.completeness:.1%}",
                ]
            )
    return markdown.table(rows)


def dense(records: Sequence[Stored]) -> str:
    return dense_table(results(records, Record[DenseResult]))


def dense_table(found: Sequence[DenseResult]) -> str:
    rows = [["scene", "photographs", "median error", "below 0.5, 1, 2 %", "with a depth"]]
    rows[0] += ["of these below 0.5, 1, 2 %", "points", "CPU s a photograph"]
    rows[0] += ["instruction set", "peak (MB)"]
    for r in found:
        shares = [", ".join(f"{share:.1%}" for share in s) for s in (r.within, r.within_known)]
        cells = [r.scene, f"{r.photographs}, {r.pixels}", f"{r.median_error:.3%}", shares[0]]
        cells += [f"{r.completeness:.1%}", shares[1], f"{r.points / 1e6:.2f}M"]
        cells += [f"{r.cpu_s_per_photograph:.2f}", r.instruction_set, f"{r.peak_mb:.0f}"]
        rows.append(cells)
    return markdown.table(rows)


def coverage(records: Sequence[Stored]) -> str:
    """Gains are of the removed views; of random viewpoints, the median over the draws."""
    rows = [
        [
            *("removed views", "trust: test, removed", "PSNR: test, removed (dB)"),
            *("rank correlation", "distance: proposed, random (m)"),
            *("nearer than random draws", "gain: proposed, random (dB)"),
        ]
    ]
    for r in results(records, Record[CoverageResult]):
        gains = [gain["removed"] for gain in r.added_random]
        rows.append(
            [
                r.case,
                f"{r.trust['test']:.2f}, {r.trust['removed']:.2f}",
                f"{r.psnr['test']:.2f}, {r.psnr['removed']:.2f}",
                f"{r.rank_correlation:.2f}",
                f"{r.first[0]:.2f}, {r.random_first[0]:.2f}",
                f"{r.better_than_random:.0%}",
                f"{r.added_first['removed']:+.2f}, "
                + cell(statistics.median(gains) if gains else None, "+.2f"),
            ]
        )
    return markdown.table(rows)


def memory(records: Sequence[Stored]) -> str:
    rows = [["Gaussians", "views, pixels", "planned (MB)", "peak (MB)", "planned / peak"]]
    for r in results(records, Record[MemoryResult]):
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


def sfm(records: Sequence[Stored]) -> str:
    return summary.table(summary.summaries(results(records, Record[summary.Run])))


def growth(records: Sequence[Stored]) -> str:
    return markdown.table(
        [GROWTH_HEADING, *map(growth_row, results(records, Record[GrowthResult]))]
    )


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


def judge(records: Sequence[Stored]) -> str:
    return verdicts(results(records, Record[JudgeResult]))


def verdicts(found: Sequence[JudgeResult]) -> str:
    """The confusion table of true grades and verdicts."""
    counts = Counter((row.truth.grade, row.verdict) for row in found if row.truth is not None)
    rows = [["truth", *(f"called {grade}" for grade in GRADES)]]
    rows += [[true, *(str(counts[true, called]) for called in GRADES)] for true in GRADES]
    return markdown.table(rows)


def stability(records: Sequence[Stored]) -> str:
    return outcomes(results(records, Record[StabilityResult]))


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


def page(records: Sequence[Stored]) -> str:
    rows = [["splats", "view", "PSNR (dB)"]]
    rows += [[r.file, r.view, f"{r.psnr:.2f}"] for r in results(records, Record[PageResult])]
    return markdown.table(rows)


def raster_stress(records: Sequence[Stored]) -> str:
    rows = [
        [
            *("family", "cases", "drawn", "dropped", "not finite", "colour error"),
            *("gradient error: median", "99 %", "worst"),
        ]
    ]
    for r in results(records, Record[StressResult]):
        counts = (r.cases, r.drawn, r.dropped, r.not_finite)
        errors = (r.colour, r.gradient_median, r.gradient_p99, r.gradient_worst)
        rows.append([r.family, *map(str, counts), *(f"{error:.1e}" for error in errors)])
    return markdown.table(rows)


def video(records: Sequence[Stored]) -> str:
    rows = [["video", "frames", "chosen", "sharpness", "of evenly spaced frames", "ratio"]]
    for r in results(records, Record[VideoFrames]):
        rows.append(
            [
                *(r.video, str(r.frames), str(r.chosen), f"{r.chosen_sharpness:.0f}"),
                *(f"{r.even_sharpness:.0f}", f"{r.chosen_sharpness / r.even_sharpness:.2f}"),
            ]
        )
    return markdown.table(rows)


def blocks(records: Sequence[Stored]) -> str:
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
    for r in results(records, Record[BlocksResult]):
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


def scaling(records: Sequence[Stored]) -> str:
    return scaling_table(results(records, Record[ScalingResult]))


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


def wide(records: Sequence[Stored]) -> str:
    return lenses(results(records, Record[WideResult]))


def lenses(found: Sequence[WideResult]) -> str:
    rows = [
        [
            *("lens", "pixels", "photographs", "with a pose", "views", "pixels used"),
            *("rotation: median, mean, deg", "centre", "PSNR (dB)", "SSIM"),
        ]
    ]
    for r in found:
        rows.append(
            [
                *(r.lens, r.pixels, str(r.photographs), str(r.registered), str(r.views)),
                cell(r.used_share, ".1%"),
                f"{r.rotation_median_deg:.4f}, {r.rotation_mean_deg:.4f}",
                f"{r.centre_relative_median:.3%}",
                *(f"{r.psnr:.2f}", f"{r.ssim:.4f}"),
            ]
        )
    return markdown.table(rows)


def pose_conventions(records: Sequence[Stored]) -> str:
    return poses_table(results(records, Record[PoseResult]))


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


def georeference(records: Sequence[Stored]) -> str:
    return verdicts_table(results(records, Record[GeoreferenceResult]))


def verdicts_table(found: Sequence[GeoreferenceResult]) -> str:
    """A row for each source of a world frame: the verdicts on its cases."""
    rows = [["measured by", "cases", "surveys", *GEOREFERENCE_VERDICTS]]
    for source in ("GPS", "ground control points"):
        own = [r for r in found if r.case.startswith("GPS") == (source == "GPS")]
        counts = [sum(r.verdict == verdict for r in own) for verdict in GEOREFERENCE_VERDICTS]
        rows.append([source, str(len({r.case for r in own})), str(len(own)), *map(str, counts)])
    return markdown.table(rows)


def slurm(records: Sequence[Stored]) -> str:
    return slurm_table(results(records, Record[SlurmResult]))


def slurm_table(found: Sequence[SlurmResult]) -> str:
    rows = [["scene", "nodes", "blocks", "jobs"]]
    rows[0] += ["wall (s)", "a job runs (s)", "none runs (s)", "training of blocks (s)"]
    for r in found:
        times = (r.wall_s, r.busy_s, r.wall_s - r.busy_s)
        counts = (r.nodes, r.blocks, r.jobs)
        seconds = (*(f"{value:.0f}" for value in times), cell(r.blocks_s, ".0f"))
        rows.append([r.scene, *map(str, counts), *seconds])
    return markdown.table(rows)


def budgets(records: Sequence[Stored]) -> str:
    return budget_tables.table(results(records, Record[BudgetResult]))


def budget_curves(records: Sequence[Stored]) -> str:
    """PSNR by training time."""
    return budget_tables.curves(results(records, Record[BudgetResult]))


TABLES: dict[str, Callable[[Sequence[Stored]], str]] = {
    "mesh": mesh,
    "dense": dense,
    "coverage": coverage,
    "memory": memory,
    "sfm": sfm,
    "sfm.growth": growth,
    "judge": judge,
    "stability": stability,
    "page": page,
    "raster_stress": raster_stress,
    "blocks": blocks,
    "budgets": budgets,
    "georeference": georeference,
    "pose_conventions": pose_conventions,
    "scaling": scaling,
    "slurm": slurm,
    "video": video,
    "wide": wide,
}
"""The table of each benchmark, by the ``benchmark`` of its record."""
