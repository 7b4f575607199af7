"""The waits, dispatches and bytes of a training step on a GPU, which do not depend on the card.

    python -m benchmarks.gpu_counts --gaussians 1000000 --size 1600x1067

The counts are means of a step; results are read after the last one.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter

import torch

from benchmarks.raster.scenes import size_of, synthetic
from pipeline.render import make_backend
from pipeline.render.calibration import StepScene, training_step
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.counts import Counts
from pipeline.runtime.errors import UserError

SHOWN = 14  # The number of buffers that are printed.


def counted_steps(backend: GpuBackend, scene: StepScene, steps: int) -> tuple[Counts, float]:
    """The counts of ``steps`` training steps, and the seconds of one in the thread that records."""
    step = training_step(backend, scene, steps)
    step()  # Allocates memory and compiles kernels.
    gpu = backend.gpu
    gpu.counts = counts = Counts(groups=Counter())
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
    read, written = ({k: v / steps / 1e6 for k, v in part.items()} for part in counts.traffic())
    both = Counter(read) + Counter(written)
    print(f"bytes        {both.total():8.2f} MB")
    for name, size in both.most_common(SHOWN):
        parts = f"{read.get(name, 0):8.2f} read, {written.get(name, 0):8.2f} written"
        print(f"  {name:32} {size:8.2f} MB: {parts}")


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
        counts, seconds = counted_steps(
            backend, StepScene(scene.gaussians, scene.camera, target), args.steps
        )
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{args.gaussians} Gaussians, {width}x{height}; means of {args.steps} steps")
    report(counts, args.steps)
    print(f"processor    {1e3 * seconds:8.2f} ms of the thread that records a step")
    return 0


if __name__ == "__main__":
    sys.exit(main())
