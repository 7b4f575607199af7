"""Published figures beside those of own records of the same protocol."""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks import markdown
from benchmarks.budgets.points import OURS
from pipeline.plan.protocols import PUBLISHED_SCENES
from pipeline.reporting.batch import PUBLISHED

Stored = Mapping[str, Any]
HEADING = [
    *("scene", "method", "PSNR (dB)", "SSIM", "LPIPS", "Gaussians", "minutes of training, machine"),
    "source",
]


@dataclass(frozen=True)
class Own:
    """Measures of a published scene, with nothing done otherwise; medians over seeds.

    Attributes:
        method: what was run.
        minutes: CPU time of training.
        where: the machine.
    """

    benchmark: str
    scene: str
    method: str
    psnr: float
    ssim: float
    lpips: float | None
    gaussians: float
    minutes: float
    where: str


def like_for_like(records: Sequence[Stored]) -> str:
    """For each benchmark the means over its scenes, then each scene that was measured.

    Published rows that say how they differ from the benchmark's protocol are left out, and so are
    own runs with deviations from it. A dash: not measured, or not published.
    """
    published = [p for p in json.loads(PUBLISHED.read_text())["results"] if not p["differs"]]
    own = [figure for record in records for figure in own_figures(record)]
    rows = [HEADING]
    for benchmark in dict.fromkeys(entry["dataset"] for entry in published):
        entries = [entry for entry in published if entry["dataset"] == benchmark]
        ours = [figure for figure in own if figure.benchmark == benchmark]
        scenes = [s.scene for s in PUBLISHED_SCENES.values() if s.benchmark == benchmark]
        title = f"{benchmark}, mean of {len(scenes)}"
        rows += _means(title, scenes, ours)
        rows += [_published(title, entry, entry["mean"]) for entry in entries]
        for scene in scenes:
            of_scene = [figure for figure in ours if figure.scene == scene]
            if of_scene:
                title = f"{scene} of {benchmark}"
                rows += [_own(title, figure) for figure in of_scene]
                listed = [entry for entry in entries if scene in entry["scenes"]]
                rows += [_published(title, e, e["scenes"][scene]) for e in listed]
    return markdown.table(rows)


def own_figures(record: Stored) -> list[Own]:
    """The figures of a record of scenes or budgets that are as published."""
    where = f"{record['cores']} cores, {record['instruction_set']}"
    if record.get("benchmark") == "budgets":
        return _of_budgets(record, where)
    published = record["protocol"].get("published")
    if not published or published["deviations"]:
        return []
    runs = record["runs"]
    lpips = [run["lpips"] for run in runs if run["lpips"] is not None]
    return [
        Own(
            published["benchmark"],
            published["scene"],
            f"splatmake, {record['training'] or 'see its command'}",
            statistics.median(run["psnr"] for run in runs),
            statistics.median(run["ssim"] for run in runs),
            statistics.median(lpips) if lpips else None,
            statistics.median(run["gaussians"] for run in runs),
            statistics.median(run["cpu_s"]["train"] for run in runs) / 60,
            where,
        )
    ]


def _of_budgets(record: Stored, where: str) -> list[Own]:
    """The longest budget of each scene, of which all points have one configuration."""
    alike = [
        point
        for point in record["results"]
        if point["trainer"] == OURS and point["benchmark"] and not point["deviations"]
    ]
    found = []
    for scene in dict.fromkeys(point["published_scene"] for point in alike):
        points = [point for point in alike if point["published_scene"] == scene]
        longest = max(point["minutes"] for point in points)
        points = [point for point in points if point["minutes"] == longest]
        lpips = [point["lpips"] for point in points if point["lpips"] is not None]
        found.append(
            Own(
                points[0]["benchmark"],
                scene,
                f"splatmake, {longest:g} minutes",
                statistics.median(point["psnr"] for point in points),
                statistics.median(point["ssim"] for point in points),
                statistics.median(lpips) if lpips else None,
                statistics.median(point["gaussians"] for point in points),
                statistics.median(point["cpu_minutes"] for point in points),
                where,
            )
        )
    return found


def _means(title: str, scenes: Sequence[str], ours: Sequence[Own]) -> list[list[str]]:
    """A row for each method that measured all scenes; one of dashes if none did."""
    rows = []
    for method in dict.fromkeys(figure.method for figure in ours):
        figures = {figure.scene: figure for figure in ours if figure.method == method}
        if figures.keys() >= set(scenes):
            each = [figures[scene] for scene in scenes]
            lpips = [figure.lpips for figure in each if figure.lpips is not None]
            mean = Own(
                each[0].benchmark,
                "",
                method,
                statistics.fmean(figure.psnr for figure in each),
                statistics.fmean(figure.ssim for figure in each),
                statistics.fmean(lpips) if len(lpips) == len(each) else None,
                statistics.fmean(figure.gaussians for figure in each),
                statistics.fmean(figure.minutes for figure in each),
                each[0].where,
            )
            rows.append(_own(title, mean))
    return rows or [[title, OURS, *["-"] * (len(HEADING) - 2)]]


def _own(title: str, figure: Own) -> list[str]:
    return [
        *(title, f"**{figure.method}**", f"{figure.psnr:.2f}", f"{figure.ssim:.3f}"),
        *(markdown.cell(figure.lpips, ".3f"), _count(figure.gaussians)),
        *(f"{figure.minutes:.1f} (CPU), {figure.where}", "records above"),
    ]


def _published(title: str, entry: Stored, measures: Mapping[str, float]) -> list[str]:
    minutes = entry.get("minutes")
    time = "-" if minutes is None else f"{minutes:g}, {entry['machine']}"
    return [
        *(title, entry["method"], f"{measures['psnr']:.2f}"),
        *(markdown.cell(measures.get(name), ".3f") for name in ("ssim", "lpips")),
        *(_count(entry.get("gaussians")), time if measures is entry["mean"] else "-"),
        _source(entry),
    ]


def _source(entry: Stored) -> str:
    """First author, address and table of a paper."""
    author = entry["source"].split(",")[0]
    number = entry["address"].rpartition("/")[2]
    where = f"table {entry['table']}" if entry["table"][0].isdigit() else entry["table"]
    return f"[{author} et al., arXiv {number}]({entry['address']}), {where}"


def _count(gaussians: float | None) -> str:
    return "-" if gaussians is None else f"{gaussians / 1e6:.2f}M"
