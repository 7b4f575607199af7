"""A model of a training step's time on some cards, from its counts. No card has confirmed it.

Bytes move at the full bandwidth, and none comes from a cache. Each pixel of a tile blends all of
the tile's Gaussians at the full arithmetic, which does not overlap with the bytes. Each dispatch
takes some microseconds of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks import markdown
from benchmarks.results import GpuCountsResult

# The least bytes of a step, each number read and written once: of a Gaussian, 11 parameters with
# two moments each, 48 SH coefficients with first moments of 2 bytes and 16 second moments, two
# statistics and its last step; of a pair, its Gaussian and ten moments of gradients; of a pixel,
# its colour and the gradient on it, while the photograph's bytes are only read.
GAUSSIAN_BYTES = 2 * (4 * 3 * 11 + (4 + 2) * 48 + 4 * 16 + 4 * 3)
PAIR_BYTES, PIXEL_BYTES = 2 * 4 * 11, 2 * 4 * 6 + 3
DISPATCH_MS = 4e-3  # Assumed: the start of a kernel and the barrier before it.


@dataclass(frozen=True)
class Card:
    """The peaks of a card by its maker: GB/s of memory, and float32 TFLOP/s."""

    name: str
    bandwidth: float
    tflops: float

    def milliseconds(self, step: GpuCountsResult) -> tuple[float, float, float]:
        """The modelled times of memory, of arithmetic and of dispatches in a step."""
        memory = sum(step.memory_mb.values()) / self.bandwidth
        return memory, step.gflop / self.tflops, DISPATCH_MS * step.dispatches


CARDS = (
    Card("H100 SXM", 3350, 66.9),
    Card("RTX 4090", 1010, 82.6),
    Card("Arc A770", 560, 19.7),
    Card("M2, 10 cores", 100, 3.6),
)


def counts_table(found: Sequence[GpuCountsResult]) -> str:
    """A row for each scene."""
    rows = [
        [
            *("Gaussians, pixels", "pairs", "waits", "dispatches of a step"),
            *("copies of a step", "memory of a step (MB)", "least memory (MB)", "ratio"),
            "arithmetic of a step (GFLOP)",
        ]
    ]
    for r in found:
        waits = f"{r.waits} in {r.steps} steps"
        counts = (f"{r.dispatches:.0f}", f"{r.copies:.0f}")
        memory, least = sum(r.memory_mb.values()), least_mb(r)
        work = (f"{memory:.0f}", f"{least:.0f}", f"{memory / least:.2f}", f"{r.gflop:.1f}")
        rows.append([_scene(r), f"{r.pairs:,}", waits, *counts, *work])
    return markdown.table(rows)


def least_mb(result: GpuCountsResult) -> float:
    """The bytes of a step's parameters, moments, pairs and images, read and written once, in MB."""
    pixels = result.width * result.height
    sizes = GAUSSIAN_BYTES * result.gaussians, PAIR_BYTES * result.pairs, PIXEL_BYTES * pixels
    return 1e-6 * sum(sizes)


def model_table(found: Sequence[GpuCountsResult]) -> str:
    """A row for each card and scene."""
    rows = [["card", "Gaussians, pixels", "memory (ms)", "arithmetic (ms)", "dispatches (ms)"]]
    rows[0].append("step (ms)")
    for card in CARDS:
        peaks = f"{card.name}, {card.bandwidth:.0f} GB/s, {card.tflops:.0f} TFLOP/s"
        for r in found:
            parts = card.milliseconds(r)
            rows.append([peaks, _scene(r), *(f"{part:.1f}" for part in (*parts, sum(parts)))])
    return markdown.table(rows)


def _scene(result: GpuCountsResult) -> str:
    return f"{result.gaussians // 1000}k, {result.width}x{result.height}"
