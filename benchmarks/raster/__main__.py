"""Times the rasterizer's operators and holds them to the twin; see docs/raster.md."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

# torch's threads, which the twin runs on, must not spin: they would take our kernels' time.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from benchmarks.raster.accuracy import accuracy, twin_ratio
from benchmarks.raster.measure import (
    BLOCK_OPERATIONS,
    Peak,
    Step,
    block_pairs,
    contributing_pairs,
    measured_peak,
)
from benchmarks.raster.probe import OPERATORS, versus
from benchmarks.raster.scenes import Scene, synthetic, trained
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import machine_facts

COUNTS = [10_000, 50_000, 200_000, 1_000_000]
SIZES = [(480, 270), (960, 540), (1920, 1080)]


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT, found {text!r}")
    return int(width), int(height)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.raster",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="Gaussians")
    parser.add_argument(
        "--sizes", type=_size, nargs="+", default=SIZES, metavar="WxH", help="image sizes, pixels"
    )
    parser.add_argument("--radius", type=float, default=5.0, help="mean 3-sigma radius, pixels")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seconds", type=float, default=2.0, help="spent on a scene's times")
    parser.add_argument(
        "--model", type=Path, help="measure this export folder instead: point_cloud.ply, sparse/0"
    )
    parser.add_argument(
        "--probe", type=Path, help="another program to run in turns; benchmarks/raster/probe.py"
    )
    parser.add_argument("--turns", type=int, default=9, help="with --probe")
    parser.add_argument("--json", type=Path, help="write the same as data")
    return parser.parse_args()


def _measure(scene: Scene, threads: int, peak: Peak, args: argparse.Namespace) -> dict[str, Any]:
    step = Step(scene, threads)
    pairs, error = contributing_pairs(step), accuracy(step)
    costs = step.costs(pairs)
    print(
        f"\n{scene.name}; {threads} threads; {pairs / 1e6:.3f}M contributing pairs, "
        f"{step.drawn.num_intersections} (Gaussian, tile) pairs\n"
        f"error against the float64 twin: colour {error.colour:.1e}, "
        f"gradients {error.gradient:.1e} relative\n"
        f"{'':24} {'ms':>8} {'CPU ms':>8} {'Mpairs/s':>9} {'of peak':>8}"
    )
    operators: dict[str, dict[str, Any]] = {}
    for name, timing in step.time(args.seconds).items():
        rate = pairs / timing.cpu / 1e3
        share = costs[name].seconds(peak) * 1e3 / timing.cpu if name in costs else None
        operators[name] = {
            "ms": timing.wall, "cpu_ms": timing.cpu, "pairs_per_s": 1e6 * rate, "of_peak": share,
        }  # fmt: skip
        shown = "" if share is None else f"{share:8.2f}"
        print(f"{name:24} {timing.wall:8.2f} {timing.cpu:8.2f} {rate:9.1f} {shown}")
    blocks = block_pairs(step)
    least = {
        name: 1e3 * n * blocks / peak.vector_operations for name, n in BLOCK_OPERATIONS.items()
    }
    over = {name: operators[name]["cpu_ms"] / ms for name, ms in least.items() if blocks}
    for name, ratio in over.items():
        operators[name]["of_bound"] = ratio
    shown = ", ".join(f"{name} {ratio:.2f}x" for name, ratio in over.items())
    print(
        f"{blocks / 1e6:.3f}M (Gaussian, block of 16 pixels) pairs; to what their vector "
        f"operations take alone: {shown}"
    )
    result = {
        "scene": scene.name, "gaussians": scene.count, "size": list(step.state.size),
        "threads": threads, "pairs": pairs, "block_pairs": blocks,
        "tile_pairs": step.drawn.num_intersections,
        "operators": operators, "error": asdict(error),
    }  # fmt: skip
    if args.probe:
        found = versus(step, args.probe, args.turns)
        cells = [f"{n} {found.ours[n]:.2f} to {found.theirs[n]:.2f}" for n in OPERATORS]
        print(
            f"to the probe's, CPU ms: {', '.join(cells)}; all {found.ratio:.2f}x, "
            f"our whole step {found.step_ratio:.2f}x"
        )
        result["probe"] = {**asdict(found), "ratio": found.ratio, "step_ratio": found.step_ratio}
    return result


def main() -> None:
    args = _arguments()
    scenes = (
        [lambda: trained(args.model)]
        if args.model
        else [
            lambda n=n, w=w, h=h: synthetic(n, w, h, args.radius)
            for w, h in args.sizes
            for n in args.counts
        ]
    )
    results, peaks, ratios = [], [], []
    for threads in args.threads:
        peak = measured_peak(threads)
        peaks.append(peak)
        ratio = twin_ratio(threads)
        ratios.append({"threads": threads, **asdict(ratio)})
        print(
            f"{threads} threads: peak {peak.flops / 1e9:.0f} GFLOP/s, {peak.bytes / 1e9:.1f} GB/s; "
            f"{ratio.scene}, forward and backward: twin {ratio.twin:.0f} ms, kernels "
            f"{ratio.kernels:.2f} ms, 1 : {ratio.twin / ratio.kernels:.0f} (the twin holds every "
            "pixel of every Gaussian: no larger scene fits)"
        )
    for make in scenes:
        scene = make()
        for threads, peak in zip(args.threads, peaks, strict=True):
            results.append(_measure(scene, threads, peak, args))
    if args.json:
        value = {
            "machine": machine_facts(),
            "peak": [asdict(p) for p in peaks],
            "twin": ratios,
            "results": results,
        }
        write_json(args.json, value)


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(str(error))
