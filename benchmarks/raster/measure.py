"""Times of the operators of a training step, and lower bounds of their work."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from benchmarks.raster.peak import Calibration, Peak
from benchmarks.raster.scenes import Scene
from pipeline.config.experiments import DEFAULT
from pipeline.config.schema import Train
from pipeline.render import RasterOptions, make_backend
from pipeline.render.cpu import build

BACKGROUND = (0.1, 0.2, 0.3)
SSIM_WEIGHT = Train().ssim_loss_weight
SQUARED_ERROR_WEIGHT = DEFAULT.train.squared_error_loss_weight
MIN_TURNS = 5  # The least number of turns that has quartiles.
TILE_PIXELS = 16 * 16
# The least number of operations of one Gaussian on all pixels of a block: offset 2, exponent 2,
# 2^x 11, clamping 3, transmittance 3; forward: colour and remaining transmittance 4; backward:
# offset 2, transmittance 1, gradient of the pixel 4, alpha / (1 - alpha) 5, v 4, moments of v and
# of colour 11. Each takes as many instructions as registers hold the pixels of the block. "Of
# bound" is the measured time over the time of these instructions at the rate at which the processor
# starts multiply-adds. It is not a strict bound: processors with further units for other operations
# start more of them.
BLOCK_OPERATIONS = {"blend": 25, "blend backward": 48}


@dataclass(frozen=True)
class Cost:
    """The lower bound of the work of an operator on a scene: float32 operations and bytes."""

    flops: float
    bytes: float

    def seconds(self, peak: Peak) -> float:
        """The time at the peak of the machine, by the tighter of the two limits."""
        return max(self.flops / peak.flops, self.bytes / peak.bytes)


@dataclass(frozen=True)
class Timing:
    """The milliseconds of wall time, and of CPU time over threads, which depends less on load."""

    wall: float
    cpu: float


@dataclass(frozen=True)
class Turn:
    """One step: the time of each operator, and the operations per second that the calibration loop
    reached just before."""

    flops: float
    times: dict[str, Timing]


@dataclass(frozen=True)
class Spread:
    """The median and quartiles over turns."""

    median: float
    low: float
    high: float

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        low, median, high = statistics.quantiles(values, n=4, method="inclusive")
        return Spread(median, low, high)


class Step:
    """A training step on a scene, operator by operator; ``operators`` run in this order."""

    def __init__(self, scene: Scene, threads: int):
        build.load()
        kernels: Any = torch.ops.splatmake
        options = RasterOptions(background=BACKGROUND, threads=threads)
        self.scene, self.threads = scene, threads
        self.drawn = make_backend("cpu").forward(*scene.gaussians, scene.camera, options)
        self.state = s = self.drawn.state
        p = s.projected
        gen = torch.Generator().manual_seed(1)
        target = torch.rand(*self.drawn.color.shape, generator=gen)
        params = [g.clone() for g in p.inputs]
        means, log_scales, _, opacity_logits, sh = params
        # Those of rotations are about three axes.
        shapes = means, means, log_scales, opacity_logits, sh
        moments = [torch.zeros_like(like) for like in shapes for _ in range(2)]
        last = torch.zeros(scene.count, dtype=torch.int32)
        # The learning rates are 0, so that every repeat renders the same.
        rate = torch.tensor([1, 0.8, 0.999, 1e-15, 0], dtype=torch.float64)
        rates = torch.tensor([1, 0.8, 0.999, 1e-15, 0, 0], dtype=torch.float64)
        statistics = torch.zeros(scene.count), torch.zeros(scene.count)
        images = self.drawn.color, None, target, None
        loss_of = (*images, SSIM_WEIGHT, SQUARED_ERROR_WEIGHT, threads)
        self.d_color = kernels.l1_ssim(*loss_of)[4]
        kept: dict[str, Any] = {}

        def project() -> None:
            kernels.project(*p.inputs, p.view, threads)

        def bin_() -> None:
            kernels.bin(p.records, p.radii, p.view, threads)

        def blend() -> None:
            kernels.blend(p.records, s.entries, s.tile_begin, p.view, threads)

        def loss() -> None:
            kernels.l1_ssim(*loss_of)

        def blend_backward() -> None:
            kept["slots"] = kernels.blend_backward(
                p.records, s.entries, s.tile_begin, s.block_end, p.view, self.drawn.color,
                self.drawn.alpha, None, self.d_color, None, None, threads,
            )  # fmt: skip

        def project_backward() -> None:
            kernels.project_backward_update(
                *params, p.view, p.records, p.radii, s.slots, kept["slots"], moments, last,
                [rates, rate, rate, rates], *statistics, False, False, threads,
            )  # fmt: skip

        self.operators: dict[str, Callable[[], None]] = {
            "projection, SH": project,
            "bin": bin_,
            "blend": blend,
            "loss": loss,
            "blend backward": blend_backward,
            "projection backward, Adam": project_backward,
        }

    def costs(self, pairs: int) -> dict[str, Cost]:
        """The lower bounds, given the number of contributing (pixel, Gaussian) pairs: the
        operations of useful lanes (a multiply-add is two), and every array read or written once."""
        n, pixels = self.scene.count, self.drawn.alpha.numel()
        visible, tiles = int((self.drawn.radii > 0).sum()), self.drawn.num_intersections
        row = 4 * sum(g[0].numel() for g in self.scene.gaussians) if n else 0
        sh = 4 * self.scene.gaussians[4][0].numel() if n else 0
        record, entry, slot = 64, 12, 64
        # 8 blurs (5 forward, 3 of the gradient) of 6 taps take 17 operations twice; others some 30.
        loss = 3 * pixels * (8 * 2 * 17 + 30)
        return {
            "projection, SH": Cost(n * 400, n * row + visible * record),
            "bin": Cost(0, visible * (record + 3 * 16 + 8) + tiles * entry),
            "blend": Cost(28 * pairs, visible * record + tiles * entry + 16 * pixels),
            "loss": Cost(loss, 36 * pixels),
            "blend backward": Cost(56 * pairs, tiles * (entry + slot) + 28 * pixels),
            # Parameters and their moments are read and written, those of SH for Gaussians in view.
            # Quaternions have moments of 3 floats.
            "projection backward, Adam": Cost(
                n * 800, n * (6 * (row - sh) - 4 * 4 + 2 * 8) + 6 * visible * sh + tiles * slot
            ),
        }

    def once(self) -> dict[str, Timing]:
        """The time of every operator in one step, and of the whole step ("step")."""
        times = {}
        for name, run in self.operators.items():
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            cpu = (time.process_time() - cpu) / self.threads
            times[name] = Timing(1e3 * (time.perf_counter() - wall), 1e3 * cpu)
        times["step"] = Timing(
            sum(t.wall for t in times.values()), sum(t.cpu for t in times.values())
        )
        return times


def take_turns(steps: Sequence[Step], calibration: Calibration, seconds: float) -> list[list[Turn]]:
    """Run the steps in alternation for ``seconds`` in total; returns the turns of each step. So the
    compared turns have run under the same load."""
    for step in steps:
        step.once()  # touches newly allocated memory
    taken: list[list[Turn]] = [[] for _ in steps]
    end = time.monotonic() + seconds
    while time.monotonic() < end or len(taken[0]) < MIN_TURNS:
        for turns, step in zip(taken, steps, strict=True):
            flops = calibration.flops(step.threads)
            step.once()  # as in training, where steps follow each other: threads are awake
            turns.append(Turn(flops, step.once()))
    return taken


def block_pixels(step: Step) -> int:
    """The pixels of a block; the kernels' blocks depend on their target."""
    tiles = step.state.tile_begin.numel() - 1
    return TILE_PIXELS * tiles // step.state.block_end.numel()


def block_pairs(step: Step) -> int:
    """The number of (Gaussian, block) pairs to evaluate: those of the bins, up to the point at
    which the last pixel of a block terminates."""
    state = step.state
    counts = state.tile_begin.diff()
    tile = torch.repeat_interleave(torch.arange(len(counts)), counts)
    rank = torch.arange(len(tile)) - state.tile_begin[:-1][tile]
    ends = state.block_end.view(len(counts), -1)
    blocks = state.entries[:, 2]
    numbers = range(ends.shape[1])
    return sum(int(((blocks >> b & 1) * (rank < ends[tile, b])).sum()) for b in numbers)


def contributing_pairs(step: Step) -> int:
    """The number of contributing (pixel, Gaussian) pairs of the image, from torch, by tile."""
    state = step.state
    width, height = state.projected.size
    tiles_x, tiles_y = -(-width // 16), -(-height // 16)
    begin = state.tile_begin
    counts = begin.diff()
    order = torch.argsort(counts, descending=True, stable=True)
    x = (order % tiles_x * 16).float()[:, None] + torch.arange(256).remainder(16) + 0.5
    y = (order // tiles_x * 16).float()[:, None] + torch.arange(256).div(16).floor() + 0.5
    left = ((x < width) & (y < height)).float()
    counts, first = counts[order], begin[:-1][order]
    assert len(order) == tiles_x * tiles_y
    records = state.projected.records
    centres, fields = records[:, :4].view(torch.float64), records[:, 4:8]
    pairs = 0
    for rank in range(int(counts[0]) if len(counts) else 0):
        tiles = int((counts > rank).sum())
        gaussian = state.entries[first[:tiles] + rank, 0].long()
        dx = x[:tiles] - centres[gaussian, :1].float()
        dy = y[:tiles] - centres[gaussian, 1:].float()
        uu, uw, ww, log2_opacity = fields[gaussian].unsqueeze(-1).unbind(1)
        power = log2_opacity - (uu * dx + uw * dy) ** 2 - (ww * dy) ** 2
        alpha = power.exp2().clamp(max=0.999)
        after = left[:tiles] * (1 - alpha)
        seen = alpha >= 1 / 255
        drawn = seen & (after >= 1e-4)
        pairs += int(drawn.sum())
        # A terminated pixel blends no more Gaussians.
        left[:tiles] = torch.where(drawn, after, torch.where(seen, 0.0, left[:tiles]))
    return pairs
