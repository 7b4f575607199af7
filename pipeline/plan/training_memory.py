"""Estimate of training's peak memory, fitted to measurements (``python -m benchmarks.memory``)."""

from __future__ import annotations

from pipeline.runtime.machine import usable_memory

#: The Python process with torch.
PROGRAM_MB = 400
#: Parameters, Adam moments, gradients and the renderer's buffers per Gaussian.
GAUSSIAN_BYTES = 2500
#: 8-bit RGB, and a quarter more for reduced copies.
PIXEL_BYTES = 1.25 * 3
#: The share of the machine's memory that is left to other programs.
OTHERS_SHARE = 0.25


def memory_mb(pixels: int, gaussians: int) -> int:
    """Estimated peak memory of training in MB.

    Args:
        pixels: total number of pixels of the views that are kept in memory.
        gaussians: maximum number of Gaussians.
    """
    return round(PROGRAM_MB + (PIXEL_BYTES * pixels + GAUSSIAN_BYTES * gaussians) / 1e6)


def gaussians_in(megabytes: int, pixels: int) -> int:
    """The number of Gaussians that can be trained in this memory; the inverse of ``memory_mb``."""
    available = (megabytes - PROGRAM_MB) * 1e6 - PIXEL_BYTES * pixels
    return max(0, int(available / GAUSSIAN_BYTES))


def machine_mb() -> int:
    """The memory in MB that training may use on this machine if ``train.memory_mb`` is not set."""
    return round(usable_memory() / 1e6 * (1 - OTHERS_SHARE))
