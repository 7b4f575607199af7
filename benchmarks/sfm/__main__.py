"""Times camera poses from photographs alone, and measures them against the poses the scene brings;
see docs/explanation/sfm.md."""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from benchmarks.sfm.measure import STEPS, Run, Summary, as_data, run_once, summarise
from benchmarks.sfm.plot import pareto_svg
from benchmarks.sfm.scenes import REFERENCE, configurations, load_scene
from pipeline.reporting.charts import ChartPoint, pareto_front
from pipeline.runtime.atomic import write_json, write_text
from pipeline.runtime.errors import UserError

_OTHER = 2  # colour of what is neither the plan's choice nor the reference


def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sfm",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("scenes", type=Path, nargs="+", help="scene folders with known poses")
    parser.add_argument(
        "--configs",
        nargs="+",
        default=[REFERENCE, "*"],
        metavar="PATTERN",
        help="preset/mapper/pairs with * for anything; plan: the plan's choice under each preset; "
        f"{REFERENCE}: its defaults",
    )
    parser.add_argument("--every", type=_positive, default=1, help="use one photograph in so many")
    parser.add_argument("--repeats", type=_positive, default=1, help="runs of each, in turns")
    parser.add_argument("--threads", type=_positive, default=1)
    parser.add_argument("--json", type=Path, help="write all runs as data")
    parser.add_argument("--plot", type=Path, help="write time against centre error as SVG")
    return parser.parse_args(arguments)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"expected a number from 1, found {text!r}")
    return int(text)


def table(summaries: Sequence[Summary]) -> str:
    """Markdown, a scene's configurations in their order; the time of pycolmap's defaults is 1."""
    reference = {s.scene: s.total_s for s in summaries if s.configuration == REFERENCE}
    lines = [
        f"| scene | configuration | {' | '.join(STEPS)} | CPU s | of pycolmap's | rotation, deg | "
        "centre | of the radius, permille | AUC@1 | images | MiB |",
        "|---" * 13 + "|",
    ]
    for s in summaries:
        ratio = s.total_s / reference[s.scene] if s.scene in reference else None
        steps = [s.cpu_s.get(step) for step in STEPS]
        name = f"**{s.configuration}**" if s.planned else s.configuration
        cells = [
            s.scene,
            name,
            *(_cell(value, ".1f") for value in [*steps, s.total_s]),
            _cell(ratio, ".2f"),
            _cell(s.rotation_deg, ".4f"),
            _cell(s.centre, ".4g"),
            _cell(s.centre_permille, ".3f"),
            _cell(s.auc1, ".3f"),
            f"{s.registered}" + (f" ({s.failed} of {s.runs} runs failed)" if s.failed else ""),
            f"{s.peak_mb:.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def plot(summaries: Sequence[Summary]) -> str:
    """Time against centre error, one chart a scene, with the Pareto front. Named are the dots on
    it, the plan's choices and pycolmap's defaults; all have tooltips."""
    charts = {}
    for scene in dict.fromkeys(s.scene for s in summaries):
        shown = [s for s in summaries if s.scene == scene and s.centre_permille]
        dots = [
            ChartPoint(s.total_s, s.centre_permille or 0.0, _label(s), _tip(s), colour=_colour(s))
            for s in shown
        ]
        front = pareto_front(dots)
        dots = [
            dot if dot in front or _colour(s) != _OTHER else replace(dot, name="")
            for dot, s in zip(dots, shown, strict=True)
        ]
        if dots:
            charts[f"{scene}: centre error, permille of the radius"] = dots
    return pareto_svg(charts)


def _label(s: Summary) -> str:
    """Short enough to stand beside a dot."""
    preset, _, rest = s.configuration.partition("/")
    return " ".join([preset, *(part[:3] for part in rest.split("/") if part)])


def _tip(s: Summary) -> str:
    return f"{s.configuration}: {s.total_s:.1f} CPU s, {_cell(s.rotation_deg, '.4f')} degrees"


def _colour(s: Summary) -> int:
    """The page's accent for what the plan chooses, another for pycolmap's defaults."""
    return 0 if s.planned else 3 if s.configuration == REFERENCE else _OTHER


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def main(arguments: Sequence[str] | None = None) -> int:
    args = _arguments(arguments)
    scenes = [load_scene(folder, args.every) for folder in args.scenes]
    runs: dict[tuple[str, str], list[Run]] = {}
    for scene in scenes:
        count = len(scene.manifest.photos)
        print(f"{scene.name}: {count} photographs, measured against {scene.truth_kind}")
    print(f"{args.threads} threads, {args.repeats} runs of each")
    for _ in range(args.repeats):
        for scene in scenes:
            chosen = [*([None] if REFERENCE in args.configs else [])]
            for configuration in [*chosen, *configurations(scene, args.configs)]:
                run = run_once(scene, configuration, args.threads)
                runs.setdefault((scene.name, run.configuration), []).append(run)
                told = run.failure or f"{run.cpu_s:.1f} CPU s, {run.registered} images"
                print(f"{scene.name} {run.configuration}: {told}", file=sys.stderr, flush=True)
    if not runs:
        raise UserError(
            "no configuration matches: " + " ".join(args.configs),
            fix='for example --configs pycolmap plan "balanced/*"',
        )
    summaries = [summarise(group) for group in runs.values()]
    print(table(summaries))
    if args.json:
        value = {
            "machine": platform.processor() or platform.machine(),
            "cpus": os.cpu_count(),
            "threads": args.threads,
            "every": args.every,
            "summaries": [asdict(s) for s in summaries],
            "runs": [as_data(run) for group in runs.values() for run in group],
        }
        write_json(args.json, value)
    if args.plot:
        write_text(args.plot, plot(summaries))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(f"error: {error}")
