"""The waits, dispatches and bytes of a training step on a GPU, which do not depend on the card.

    python -m benchmarks.gpu_counts --gaussians 1000000 --size 1600x1067

A step of the scene is counted, since all are equal; waits are counted over more steps of a small
scene, whose results are read after the last one. From the counts follows a model of a step's time
on some cards (``benchmarks.gpu_model``).
"""

from __future__ import annotations

import argparse
import sys
import time

import torch

from benchmarks.gpu_model import counts_table, model_table
from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.raster.scenes import Scene, size_of, synthetic
from benchmarks.results import GpuCountsResult
from pipeline.render import make_backend
from pipeline.render.calibration import StepScene, training_step
from pipeline.render.gpu import layout
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.counts import Counts, Traffic
from pipeline.runtime.errors import UserError

SHOWN = 14  # The number of buffers that are printed.
SMALL = 1000, 64, 48  # Gaussians, width and height of the scene whose waits are counted.
# Operations of a pixel and a Gaussian of its tile, in blending and its backward pass, and of a
# Gaussian: as counted in benchmarks.raster.measure. Of a pixel in the loss: of loss.wgsl, with the
# borders of its tile.
PAIR_PIXEL_FLOPS, PIXEL_FLOPS, GAUSSIAN_FLOPS = 28 + 56, 1711, 1200


def measure(scene: Scene, backend: GpuBackend, steps: int) -> tuple[GpuCountsResult, float]:
    """The counts of a training step, and the seconds of the thread that records one.

    Args:
        steps: The number of steps whose waits are counted.
    """
    camera = scene.camera
    small, seconds = counted_steps(backend, _of_training(synthetic(*SMALL, radius=5.0)), steps)
    counts, _ = counted_steps(backend, _of_training(scene), 1)
    assert counts.traffic is not None and counts.pairs is not None
    both = counts.traffic.read + counts.traffic.written
    result = GpuCountsResult(
        gaussians=scene.count,
        width=camera.width,
        height=camera.height,
        pairs=counts.pairs,
        steps=steps,
        waits=small.waits,
        dispatches=counts.dispatches,
        copies=counts.copies,
        submissions=counts.submissions,
        uploaded_mb=counts.uploaded.total() / 1e6,
        memory_mb={name: size / 1e6 for name, size in both.most_common()},
        gflop=1e-9
        * (
            PAIR_PIXEL_FLOPS * layout.TILE**2 * counts.pairs
            + GAUSSIAN_FLOPS * scene.count
            + PIXEL_FLOPS * camera.width * camera.height
        ),
    )
    return result, seconds


def _of_training(scene: Scene) -> StepScene:
    camera = scene.camera
    target = torch.full((camera.height, camera.width, 3), 128, dtype=torch.uint8)
    return StepScene(scene.gaussians, camera, target)


def counted_steps(backend: GpuBackend, scene: StepScene, steps: int) -> tuple[Counts, float]:
    """The counts of ``steps`` training steps, and the seconds of one in the thread that records."""
    make_steps, gpu = training_step(backend, scene), backend.gpu
    # One step compiles the kernels and finds the number of pairs, by which their room is set.
    make_steps(1)
    gpu.counts = counts = Counts(pairs=gpu.counts.pairs, traffic=Traffic())
    start = time.thread_time()
    make_steps(steps)
    seconds = time.thread_time() - start
    gpu.counts = Counts(pairs=counts.pairs)
    return counts, seconds / steps


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu_counts",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--device", default="gpu", help="gpu or gpu:N (default: gpu)")
    parser.add_argument("--gaussians", type=int, default=100_000, help="(default: 100000)")
    parser.add_argument("--size", type=size_of, default=(640, 480), metavar="WxH")
    parser.add_argument("--steps", type=int, default=20, help="waits of so many (default: 20)")
    add_record_options(parser)
    args = parser.parse_args()
    width, height = args.size
    try:
        backend = make_backend(args.device)
        assert isinstance(backend, GpuBackend)
        scene = synthetic(args.gaussians, width, height, radius=5.0)
        result, seconds = measure(scene, backend, args.steps)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(counts_table([result]))
    for name, size in [*result.memory_mb.items()][:SHOWN]:
        print(f"{name:32} {size:8.2f} MB")
    print(f"\n{1e3 * seconds:.2f} ms of the thread that records a step\n")
    print(model_table([result]))
    if args.json:
        write_record(args.json, measured("gpu_counts", args.note), [result])
    return 0


if __name__ == "__main__":
    sys.exit(main())
