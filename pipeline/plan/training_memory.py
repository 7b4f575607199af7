"""What training takes of memory, known before it. Measured on scenes of 60 000 to a million
Gaussians (``python -m benchmarks.memory``)."""

from __future__ import annotations

from pipeline.runtime.machine import usable_memory

#: The program with torch; what a Gaussian's parameters, moments and gradients take, and what it
#: writes while a view is drawn; an 8-bit pixel, and a quarter of it while pictures are coarse.
PROGRAM_MB = 400
GAUSSIAN_BYTES = 2500
PIXEL_BYTES = 1.25 * 3
#: Of what the machine has, other programs may keep this share.
OTHERS_SHARE = 0.25


def memory_mb(pixels: int, gaussians: int) -> int:
    """What training takes at most, roughly, in MB.

    Args:
        pixels: of the views that are held in memory, together.
        gaussians: the budget.
    """
    return round(PROGRAM_MB + (PIXEL_BYTES * pixels + GAUSSIAN_BYTES * gaussians) / 1e6)


def gaussians_in(megabytes: int, pixels: int) -> int:
    """How many Gaussians can be trained in so many MB: the inverse of ``memory_mb``."""
    left = (megabytes - PROGRAM_MB) * 1e6 - PIXEL_BYTES * pixels
    return max(0, int(left / GAUSSIAN_BYTES))


def machine_mb() -> int:
    """What of this machine's memory training may take where nobody says."""
    return round(usable_memory() / 1e6 * (1 - OTHERS_SHARE))
