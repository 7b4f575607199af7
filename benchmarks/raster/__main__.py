"""Times the rasterizer's operators, or rendering alone, and compares them with the reference.

See docs/explanation/rasterizer.md.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

# torch's threads (of the reference) must not spin: they would slow down the kernels.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from benchmarks.measured import add_record_options, measured
from benchmarks.raster.accuracy import Accuracy, accuracy, reference_ratio
from benchmarks.raster.drawing import report_drawings
from benchmarks.raster.library import Library, heading, library_facts, measured_library
from benchmarks.raster.measure import (
    BLOCK_OPERATIONS,
    Spread,
    Step,
    Turn,
    block_pairs,
    block_pixels,
    contributing_pairs,
    take_turns,
)
from benchmarks.raster.peak import Calibration, Peak
from benchmarks.raster.probe import OPERATORS, versus
from benchmarks.raster.scenes import Scene, size_of, synthetic, trained
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError

COUNTS = [10_000, 50_000, 200_000, 1_000_000]
SIZES = [(480, 270), (960, 540), (1920, 1080)]


def _share(text: str) -> float:
    value = float(text)
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"expected a number above 0 and up to 1, found {text!r}")
    return value


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.raster",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="Gaussians")
    parser.add_argument(
        "--sizes", type=size_of, nargs="+", metavar="WxH",
        help="image sizes, pixels; without it 480x270 960x540 1920x1080, or the model's own",
    )  # fmt: skip
    parser.add_argument("--radius", type=float, default=5.0, help="mean 3-sigma radius, pixels")
    parser.add_argument(
        "--in-view", type=_share, default=1.0, help="share of the Gaussians that the view shows"
    )
    parser.add_argument(
        "--draw", action="store_true", help="measure rendering alone, in frames per second"
    )
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seconds", type=float, default=4.0, help="time to measure each scene")
    parser.add_argument(
        "--model", type=Path, help="measure this export folder instead: point_cloud.ply, sparse/0"
    )
    parser.add_argument(
        "--probe",
        type=Path,
        help="another program to run in alternation; see benchmarks/raster/probe.py",
    )
    parser.add_argument("--turns", type=int, default=9, help="with --probe")
    add_record_options(parser)
    return parser.parse_args()


def _header(step: Step, pairs: int, error: Accuracy, library: Library) -> None:
    print(
        f"\n{heading(library)}\n"
        f"{step.scene.name}; {step.threads} threads; {pairs / 1e6:.3f}M contributing pairs, "
        f"{step.drawn.num_intersections} (Gaussian, tile) pairs\n"
        f"error against the float64 reference: colour {error.colour:.1e}, "
        f"gradients {error.gradient:.1e} relative\n"
        f"{'':24} {'ms':>8} {'quartiles':>17} {'CPU ms':>8} {'Mpairs/s':>9} {'of peak':>8} "
        f"{'of bound':>9} {'quartiles':>12}"
    )


def _report(step: Step, turns: list[Turn], peak: Peak, library: Library) -> dict[str, Any]:
    """Print the table of one number of threads; returns its data."""
    pairs, blocks, error = contributing_pairs(step), block_pairs(step), accuracy(step)
    costs = step.costs(pairs)
    _header(step, pairs, error, library)
    operators: dict[str, dict[str, Any]] = {}
    for name in turns[0].times:
        wall = Spread.of([t.times[name].wall for t in turns])
        cpu = Spread.of([t.times[name].cpu for t in turns])
        found: dict[str, Any] = {
            "ms": asdict(wall), "cpu_ms": asdict(cpu), "pairs_per_s": 1e3 * pairs / cpu.median,
        }  # fmt: skip
        line = (
            f"{name:24} {wall.median:8.2f} {f'{wall.low:.2f} to {wall.high:.2f}':>17} "
            f"{cpu.median:8.2f} {found['pairs_per_s'] / 1e6:9.1f}"
        )
        if name in costs:
            # The shares are of the peak just before each step: virtual machines vary in speed.
            shares = [
                costs[name].seconds(replace(peak, flops=t.flops)) * 1e3 / t.times[name].cpu
                for t in turns
            ]
            found["of_peak"] = statistics.median(shares)
            line += f" {found['of_peak']:8.2f}"
        if name in BLOCK_OPERATIONS and blocks:
            instructions = BLOCK_OPERATIONS[name] * block_pixels(step) / library.lanes
            least = 1e3 * instructions * blocks  # ms, at one instruction a second
            over = Spread.of(
                [t.times[name].cpu * peak.instructions(t.flops) / least for t in turns]
            )
            found["of_bound"] = asdict(over)
            line += f" {over.median:8.2f}x {f'{over.low:.2f} to {over.high:.2f}':>12}"
        operators[name] = found
        print(line)
    return {
        "scene": step.scene.name, "gaussians": step.scene.count,
        "size": list(step.state.projected.size),
        "threads": step.threads, "turns": len(turns), "pairs": pairs, "block_pairs": blocks,
        "block_pixels": block_pixels(step),
        "tile_pairs": step.drawn.num_intersections, "operators": operators, "error": asdict(error),
        "flops": asdict(Spread.of([t.flops for t in turns])),
    }  # fmt: skip


def _speedups(first: Step, turns: list[Turn], other: Step, others: list[Turn]) -> dict[str, Any]:
    """The speed-up of more threads over fewer, turn by turn."""
    found = {
        name: Spread.of(
            [a.times[name].wall / b.times[name].wall for a, b in zip(turns, others, strict=True)]
        )
        for name in turns[0].times
    }
    loop = Spread.of([b.flops / a.flops for a, b in zip(turns, others, strict=True)])
    print(f"\n{first.threads} to {other.threads} threads, turn by turn (quartiles)")
    for name, ratio in {**found, "the calibration loop": loop}.items():
        print(f"{name:24} {ratio.median:8.2f}x {f'{ratio.low:.2f} to {ratio.high:.2f}':>16}")
    return {
        "scene": first.scene.name,
        "threads": [first.threads, other.threads],
        "operators": {name: asdict(ratio) for name, ratio in found.items()},
        "calibration": asdict(loop),
    }


def _against_the_probe(step: Step, probe: Path, turns: int) -> dict[str, Any]:
    found = versus(step, probe, turns)
    cells = [f"{n} {found.ours[n]:.2f} to {found.theirs[n]:.2f}" for n in OPERATORS]
    print(
        f"to the probe's, CPU ms, {step.threads} threads: {', '.join(cells)}; "
        f"all {found.ratio:.2f}x, our whole step {found.step_ratio:.2f}x"
    )
    return {**asdict(found), "ratio": found.ratio, "step_ratio": found.step_ratio}


def _scenes(args: argparse.Namespace) -> list[Callable[[], Scene]]:
    """The calls that create the scenes, one by one because of their size in memory."""
    if args.model:
        return [partial(trained, args.model, size) for size in args.sizes or [None]]
    return [
        partial(synthetic, count, width, height, args.radius, args.in_view)
        for width, height in args.sizes or SIZES
        for count in args.counts
    ]


def main() -> None:
    args = _arguments()
    library = measured_library()
    print(heading(library))
    if args.draw:
        drawn = [report_drawings(make(), args.threads, args.seconds) for make in _scenes(args)]
        record: dict[str, Any] = {"results": drawn}
    else:
        record = _operators(args, library)
    if args.json:
        facts = measured("raster", args.note).model_dump() | library_facts(library)
        write_json(args.json, facts | record)


def _operators(args: argparse.Namespace, library: Library) -> dict[str, Any]:
    """Print the tables of the operators of a training step; returns their data."""
    calibration = Calibration()
    results, speedups, peaks, ratios = [], [], [], []
    for threads in args.threads:
        peak = calibration.peak(threads)
        peaks.append(peak)
        ratio = reference_ratio(threads)
        ratios.append({"threads": threads, **asdict(ratio)})
        print(
            f"{peak}\n"
            f"{threads} threads: {ratio.scene}, forward and backward: reference "
            f"{ratio.reference:.0f} ms, kernels {ratio.kernels:.2f} ms, "
            f"1 : {ratio.reference / ratio.kernels:.0f} (the reference "
            "stores every pixel of every Gaussian: larger scenes do not fit)"
        )
    for make in _scenes(args):
        scene = make()
        steps = [Step(scene, threads) for threads in args.threads]
        taken = take_turns(steps, calibration, args.seconds)
        for step, turns, peak in zip(steps, taken, peaks, strict=True):
            result = _report(step, turns, peak, library)
            if args.probe:
                result["probe"] = _against_the_probe(step, args.probe, args.turns)
            results.append(result)
        for step, turns in zip(steps[1:], taken[1:], strict=True):
            speedups.append(_speedups(steps[0], taken[0], step, turns))
    return {
        "peak": [{**asdict(p), "per_cycle": p.per_cycle} for p in peaks],
        "reference": ratios,
        "results": results,
        "speedups": speedups,
    }


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(str(error))
