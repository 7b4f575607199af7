"""The parts of ``python -m benchmarks.card``. Each runs in a process of its own, and returns its
figures and facts (``benchmarks.card.result.CardResult``)."""

from __future__ import annotations

import hashlib
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from benchmarks.card.peak import arithmetic
from benchmarks.gpu import bandwidth, measure, median_seconds
from benchmarks.light import first_of, read_scene
from benchmarks.raster.measure import MIN_TURNS, Step, contributing_pairs
from benchmarks.raster.scenes import Scene, synthetic, trained
from pipeline.config.density import Gradient
from pipeline.config.schema import Split
from pipeline.config.settled import TrainOptions
from pipeline.metrics.image import psnr
from pipeline.metrics.protocol import choose_protocol
from pipeline.photos.load import load_rgb
from pipeline.render import RasterOptions, make_backend
from pipeline.render.calibration import StepScene, training_step
from pipeline.render.cpu import build
from pipeline.render.gpu import rasterise
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.registry import use_device
from pipeline.render.views import render_rgb, to_bytes
from pipeline.runtime.machine import usable_cores
from pipeline.splats.gaussians import Gaussians
from pipeline.training.run import TrainingRun
from pipeline.training.scene import train_scene

RADIUS = 5.0  # The mean 3-sigma radius of synthetic Gaussians, pixels.
FRAMES = 20  # The number of frames between two copies.

Figures = dict[str, float]
Facts = dict[str, str]
Found = tuple[Figures, Facts]


@dataclass(frozen=True)
class Case:
    """What a part measures at; each part uses some of the fields.

    Attributes:
        scene: The folder ``scene/`` of the pack.
        sources: The folder ``sources/`` of the pack.
        built: The folder of packages that were compiled on this machine.
    """

    scene: Path
    sources: Path
    built: Path
    device: str
    count: int
    size: tuple[int, int]
    threads: int
    turns: int
    seconds: float
    steps: int
    gaussians: int


def backend_of(case: Case) -> GpuBackend:
    """The backend of the case's GPU."""
    backend = make_backend(case.device)
    assert isinstance(backend, GpuBackend)
    return backend


def _synthetic(case: Case) -> Scene:
    return synthetic(case.count, *case.size, radius=RADIUS)


def compiled(case: Case) -> Found:
    """The time of compiling the processor's kernels."""
    start = time.perf_counter()
    built = build.library().build()
    seconds = time.perf_counter() - start
    return {"compile_s": seconds}, {"torch": torch.__version__, "target": built.target}


def device(case: Case) -> Found:
    """The device's rates."""
    gpu = backend_of(case).gpu
    figures = {
        "copies_gb_per_s": bandwidth(gpu) / 1e9,
        "arithmetic_gflop_per_s": arithmetic(gpu) / 1e9,
    }
    facts = {"device": str(gpu.adapter), "driver": gpu.adapter.driver}
    facts["features"] = ", ".join(sorted(map(str, gpu.device.features)))
    return figures, facts


def step(case: Case) -> Found:
    """A training step on the GPU by phases, with the shares of the device's rates that the least
    work of each phase takes."""
    scene, backend = _synthetic(case), backend_of(case)
    found, flops = measure(scene, backend, case.turns), arithmetic(backend.gpu)
    on_cpu = Step(scene, usable_cores())
    costs = on_cpu.costs(contributing_pairs(on_cpu))
    figures = {
        "step_ms": found.step_ms,
        "cpu_step_ms": found.cpu_step_ms,
        "frames_per_s": found.frames_per_s,
        "cpu_frames_per_s": found.cpu_frames_per_s,
        "copies_gb_per_s": found.bandwidth / 1e9,
        "arithmetic_gflop_per_s": flops / 1e9,
    }
    for phase, ms in found.phase_ms.items():
        cost, seconds = costs[phase], max(1e-9, 1e-3 * ms)
        figures[f"{phase}: ms"] = ms
        figures[f"{phase}: share_of_bandwidth"] = cost.bytes / seconds / found.bandwidth
        figures[f"{phase}: share_of_arithmetic"] = cost.flops / seconds / flops
    return figures, {"device": found.device, "driver": found.driver}


def frames(case: Case) -> Found:
    """Frames per second of the trained scene, with each copied to the processor and without."""
    scene, backend = trained(case.scene, case.size), backend_of(case)
    gpu, space = backend.gpu, Workspace(backend.gpu)
    count = 1 if gpu.adapter.kind == "software" else FRAMES
    degree = round(scene.gaussians[4].shape[1] ** 0.5) - 1
    options = RasterOptions(background=(0.1, 0.2, 0.3), sh_degree=degree)
    projected = backend.project(scene.gaussians, scene.camera, options).projection

    def draw() -> None:
        for _ in range(count):
            view = rasterise.project(space, projected.scene, projected.view, case.size)
            image = rasterise.blend(space, rasterise.list_pairs(space, view)[0], planes=True)
        gpu.read(image.color, "f4", 1)

    def copied() -> object:
        return backend.forward(*scene.gaussians, scene.camera, options)

    without, with_copy = median_seconds([draw, copied], case.turns)
    rates = {"frames_per_s": count / without, "copied_frames_per_s": 1 / with_copy}
    return {**rates, "gaussians": float(scene.count)}, {}


def same_bits(case: Case) -> Found:
    """Whether two trainings give the same Gaussians, to the bit."""
    digests = {_digest(_trained(case, case.steps, None)[0]) for _ in range(2)}
    return {"different_results": float(len(digests) - 1), "steps": float(case.steps)}, {}


def training(case: Case) -> Found:
    """The PSNR on the test views after a number of seconds."""
    start = time.perf_counter()
    gaussians, steps, ms = _trained(case, 30_000, case.seconds)
    wall = time.perf_counter() - start
    return {
        "psnr_db": _test_psnr(case, gaussians),
        "steps": float(steps),
        "step_ms": ms,
        "gaussians": float(len(gaussians)),
        "training_s": wall,
    }, {}


def processor(case: Case) -> Found:
    """The operators of a step and a whole training on some threads."""
    on_cpu = Step(_synthetic(case), case.threads)
    on_cpu.once()  # touches newly allocated memory
    turns = [on_cpu.once() for _ in range(MIN_TURNS)]
    figures = {f"{name}: ms": statistics.median(t[name].wall for t in turns) for name in turns[0]}
    _, steps, ms = _trained(case, case.steps, None)
    return {**figures, "training_step_ms": ms, "training_steps": float(steps)}, {}


def gsplat(case: Case) -> Found:
    """A step of gsplat and one of splatmake in turns."""
    from benchmarks.card.gsplat_step import gsplat_step

    scene, backend = _synthetic(case), backend_of(case)
    camera = scene.camera
    target = torch.rand(camera.height, camera.width, 3)
    ours = training_step(
        backend, StepScene(scene.gaussians, camera, (255 * target).to(torch.uint8))
    )
    theirs = gsplat_step(scene, target, case.built)
    seconds = median_seconds([ours, theirs], case.turns)
    rates = {"step_ms": 1e3 * seconds[0], "gsplat_step_ms": 1e3 * seconds[1]}
    return rates, {"torch": torch.__version__, "card": torch.cuda.get_device_name()}


def _trained(case: Case, steps: int, seconds: float | None) -> tuple[Gaussians, int, float]:
    """The Gaussians of a training, the number of its steps, and the milliseconds of one."""
    scene = read_scene(case.scene)
    options = TrainOptions.model_validate(
        {
            "steps": steps,
            "budget_minutes": None if seconds is None else seconds / 60,
            "device": case.device,
            "density": Gradient(max_gaussians=case.gaussians),
        }
    )
    use_device(options.device)
    with TemporaryDirectory() as scratch:
        run = TrainingRun(options, Path(scratch), threads=case.threads)
        result = train_scene(scene, first_of(scene, 0), run).result
    return result.gaussians, result.steps, 1e3 * result.seconds / result.steps


def _digest(gaussians: Gaussians) -> str:
    digest = hashlib.sha256()
    for array in gaussians.arrays().values():
        digest.update(array.tobytes())
    return digest.hexdigest()


def _test_psnr(case: Case, gaussians: Gaussians) -> float:
    views = [view for view in read_scene(case.scene).views if view.is_test]
    protocol = choose_protocol(views, Split(), TrainOptions())
    options = protocol.options(TrainOptions(), case.threads)
    return statistics.fmean(
        psnr(to_bytes(render_rgb(gaussians, view, options)), load_rgb(Path(view.image)))
        for view in views
    )
