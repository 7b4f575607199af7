"""The waits, dispatches and bytes of a training step on a GPU, which do not depend on the card.

    python -m benchmarks.gpu_counts --gaussians 1000000 --size 1600x1067

The counts are means of a step; results are read after the last one. From the counts and the peaks
of some cards follows an estimate of a step's time: a model, which no card has confirmed. In it,
bytes move at the full bandwidth and none comes from a cache, each pixel of a tile blends all of the
tile's Gaussians at the full arithmetic, which does not overlap with the bytes, and each dispatch
takes some microseconds of its own.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass

import torch

from benchmarks.raster.scenes import size_of, synthetic
from pipeline.render import RasterOptions, make_backend
from pipeline.render.calibration import StepScene, training_step
from pipeline.render.gpu import layout
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.counts import Counts, Traffic
from pipeline.runtime.errors import UserError

SHOWN = 14  # The number of buffers that are printed.
# Operations of a pixel and a Gaussian of its tile, in blending and its backward pass, of a pixel in
# the loss, and of a Gaussian: as counted in benchmarks.raster.measure.
PAIR_PIXEL_FLOPS, PIXEL_FLOPS, GAUSSIAN_FLOPS = 28 + 56, 906, 1200
DISPATCH_SECONDS = 4e-6  # Assumed: the start of a kernel and the barrier before it.


@dataclass(frozen=True)
class Card:
    """The peaks of a card by its maker: bytes and float32 operations per second."""

    name: str
    bandwidth: float
    flops: float

    def milliseconds(self, step: StepWork) -> tuple[float, float, float]:
        """The modelled times of memory, of arithmetic and of starting kernels, in a step."""
        parts = step.bytes / self.bandwidth, step.flops / self.flops
        return 1e3 * parts[0], 1e3 * parts[1], 1e3 * DISPATCH_SECONDS * step.dispatches


@dataclass(frozen=True)
class StepWork:
    """The work of a step on the device."""

    bytes: float
    flops: float
    dispatches: float


CARDS = (
    Card("H100 SXM", 3.35e12, 66.9e12),
    Card("RTX 4090", 1.01e12, 82.6e12),
    Card("Arc A770", 0.56e12, 19.7e12),
    Card("M2, 10 cores", 0.10e12, 3.6e12),
)


def print_model(backend: GpuBackend, scene: StepScene, counts: Counts, steps: int) -> None:
    """Print the modelled time of a step on each card."""
    camera, count = scene.camera, len(scene.gaussians[0])
    pairs = backend.forward(*scene.gaussians, camera, RasterOptions()).num_intersections
    flops = PAIR_PIXEL_FLOPS * layout.TILE**2 * pairs + GAUSSIAN_FLOPS * count
    flops += PIXEL_FLOPS * camera.width * camera.height
    assert counts.traffic is not None
    work = StepWork(counts.traffic.total / steps, flops, counts.dispatches / steps)
    print(f"{pairs} pairs, {flops / 1e9:.1f} GFLOP\nmodel, ms: memory + arithmetic + dispatches")
    for card in CARDS:
        parts = card.milliseconds(work)
        print(f"  {card.name:14} {sum(parts):7.2f} = " + " + ".join(f"{p:.2f}" for p in parts))


def counted_steps(backend: GpuBackend, scene: StepScene, steps: int) -> tuple[Counts, float]:
    """The counts of ``steps`` training steps, and the seconds of one in the thread that records."""
    step = training_step(backend, scene, steps)
    step()  # Allocates memory and compiles kernels.
    gpu = backend.gpu
    gpu.counts = counts = Counts(traffic=Traffic())
    start = time.thread_time()
    step()
    return counts, (time.thread_time() - start) / steps


def report(counts: Counts, steps: int) -> None:
    """Print the counts of a step, and its largest buffers."""
    print(f"waits        {counts.waits / steps:8.2f}")
    for name in ("dispatches", "copies", "submissions"):
        print(f"{name:12} {getattr(counts, name) / steps:8.1f}")
    for name in ("uploaded", "downloaded"):
        print(f"{name:12} {getattr(counts, name) / steps / 1e6:8.2f} MB")
    traffic, scale = counts.traffic, 1 / steps / 1e6
    assert traffic is not None
    print(f"bytes        {scale * traffic.total:8.2f} MB")
    for name, size in (traffic.read + traffic.written).most_common(SHOWN):
        read, written = scale * traffic.read[name], scale * traffic.written[name]
        print(f"  {name:32} {scale * size:8.2f} MB: {read:8.2f} read, {written:8.2f} written")


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu_counts",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--device", default="gpu", help="gpu or gpu:N (default: gpu)")
    parser.add_argument("--gaussians", type=int, default=100_000, help="(default: 100000)")
    parser.add_argument("--size", type=size_of, default=(640, 480), metavar="WxH")
    parser.add_argument("--steps", type=int, default=20, help="(default: 20)")
    args = parser.parse_args()
    width, height = args.size
    try:
        backend = make_backend(args.device)
        assert isinstance(backend, GpuBackend)
        scene = synthetic(args.gaussians, width, height, radius=5.0)
        target = torch.full((height, width, 3), 128, dtype=torch.uint8)
        step_scene = StepScene(scene.gaussians, scene.camera, target)
        counts, seconds = counted_steps(backend, step_scene, args.steps)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{args.gaussians} Gaussians, {width}x{height}; means of {args.steps} steps")
    report(counts, args.steps)
    print(f"processor    {1e3 * seconds:8.2f} ms of the thread that records a step")
    print_model(backend, step_scene, counts, args.steps)
    return 0


if __name__ == "__main__":
    sys.exit(main())
