"""A training step on a GPU, kernel by kernel, and the same step and rendering on the processor.

    python -m benchmarks.gpu --counts 50000 200000 --size 960x540
    python -m benchmarks.gpu --model results/bonsai/export --size 1920x1080

Times of kernels are the device's own timestamps. Steps and frames are wall time, GPU and processor
in turns; a frame includes its copy to the processor's memory.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch

from benchmarks.kernel_times import profiled
from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.raster.scenes import Scene, size_of, synthetic, trained
from benchmarks.results import GpuResult
from pipeline.render import RasterOptions, make_backend
from pipeline.render.calibration import StepScene, training_step
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.device import Gpu
from pipeline.runtime.errors import UserError

# The kernels of each phase of a step, in order.
PHASES = {
    "projection, SH": ("project",),
    "bin": ("sort.histogram", "sort.scan", "sort.scatter", "order", "admit", "pairs", "ranges"),
    "blend": ("blend",),
    "loss": ("loss", "sum_rows"),
    "blend backward": ("blend_backward",),
    "projection backward, Adam": ("update_gaussians",),
}
COPIED = 1 << 28  # The number of bytes that the measurement of bandwidth copies.


def median_seconds(calls: Sequence[Callable[[], object]], turns: int) -> list[float]:
    """The median wall time of each call, measured in turns after one call each."""
    times: list[list[float]] = [[] for _ in calls]
    for turn in range(turns + 1):
        for call, found in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            if turn:
                found.append(time.perf_counter() - start)
    return [statistics.median(found) for found in times]


def bandwidth(gpu: Gpu) -> float:
    """The bytes read and written per second by copies inside the device's memory."""
    size = min(COPIED, gpu.max_bytes // 4 * 4)
    source, target = gpu.empty(size), gpu.empty(size)

    def copy() -> None:
        for _ in range(4):
            gpu.copy(source, 0, target, 0, size)
        gpu.read(target, "u1", 4)

    return 4 * 2 * size / median_seconds([copy], 5)[0]


def measure(scene: Scene, backend: GpuBackend, turns: int) -> GpuResult:
    """Measure one scene."""
    cpu, gpu = make_backend("cpu"), backend.gpu
    camera = scene.camera
    generator = torch.Generator().manual_seed(1)
    target = torch.rand(camera.height, camera.width, 3, generator=generator)
    step_scene = StepScene(scene.gaussians, camera, (255 * target).to(torch.uint8))
    steps = [training_step(each, step_scene) for each in (backend, cpu)]
    seconds = median_seconds(steps, turns)
    with profiled(gpu) as profile:
        for _ in range(turns):
            steps[0]()
            profile.collect()
    options = RasterOptions(background=(0.1, 0.2, 0.3))
    frames = median_seconds(
        [partial(each.forward, *scene.gaussians, camera, options) for each in (backend, cpu)], turns
    )
    known = {kernel for kernels in PHASES.values() for kernel in kernels}
    assert known >= set(profile.seconds), f"no phase: {set(profile.seconds) - known}"
    return GpuResult(
        device=str(gpu.adapter),
        driver=gpu.adapter.driver,
        scene=scene.name,
        gaussians=scene.count,
        width=camera.width,
        height=camera.height,
        phase_ms={
            phase: 1e3 * sum(profile.seconds.get(kernel, 0.0) for kernel in kernels) / turns
            for phase, kernels in PHASES.items()
        },
        step_ms=1e3 * seconds[0],
        cpu_step_ms=1e3 * seconds[1],
        frames_per_s=1 / frames[0],
        cpu_frames_per_s=1 / frames[1],
        bandwidth=bandwidth(gpu),
        moments_bandwidth=_sh_bytes(scene) / max(1e-9, profile.seconds["update_gaussians"] / turns),
    )


def _sh_bytes(scene: Scene) -> float:
    """The bytes of the SH coefficients and their moments that a step reads and writes at least, if
    all Gaussians are in view."""
    return 2 * (4 + 2 + 4 / 3) * scene.gaussians[4].numel()


def report(result: GpuResult) -> None:
    """Print the table of one scene."""
    total = sum(result.phase_ms.values())
    print(f"\n{result.scene}, on {result.device}, {result.driver}")
    for phase, each in result.phase_ms.items():
        print(f"{phase:26} {each:9.2f} ms {100 * each / total:5.1f} %")
    waits = result.step_ms - total
    print(f"{'kernels':26} {total:9.2f} ms\n{'a step':26} {result.step_ms:9.2f} ms, ", end="")
    print(f"{waits:.2f} of them not in kernels; {result.cpu_step_ms:.2f} on the processor")
    print(
        f"{'frames per second':26} {result.frames_per_s:9.1f}, {result.cpu_frames_per_s:.1f} on "
        f"the processor\nmemory: {result.bandwidth / 1e9:.1f} GB/s by copies; projection backward "
        f"moves at least {result.moments_bandwidth / 1e9:.1f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--device", default="gpu", help="gpu or gpu:N (default: gpu)")
    parser.add_argument("--counts", type=int, nargs="+", default=[50_000], help="Gaussians")
    parser.add_argument("--size", type=size_of, default=(480, 270), metavar="WxH")
    parser.add_argument("--model", type=Path, help="measure this export folder instead")
    parser.add_argument("--turns", type=int, default=9, help="(default: 9)")
    add_record_options(parser)
    args = parser.parse_args()
    width, height = args.size
    try:
        backend = make_backend(args.device)
        assert isinstance(backend, GpuBackend)
        if args.model:
            scenes = [trained(args.model, args.size)]
        else:
            scenes = [synthetic(count, width, height, radius=5.0) for count in args.counts]
        results = []
        for scene in scenes:
            results.append(measure(scene, backend, args.turns))
            report(results[-1])
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if args.json:
        write_record(args.json, measured("gpu", args.note), results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
