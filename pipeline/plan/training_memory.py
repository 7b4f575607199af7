"""Estimate of training's peak memory, fitted to measurements (``python -m benchmarks.memory``)."""

from __future__ import annotations

import math

from pipeline.runtime.machine import usable_memory

#: MB of the Python process with torch.
PROGRAM_MB = 400
#: Bytes per Gaussian of parameters, Adam moments, gradients and the renderer's buffers.
GAUSSIAN_BYTES = 2500
#: Bytes per pixel of 8-bit RGB, and a quarter more for reduced copies.
PIXEL_BYTES = 1.25 * 3
#: MB of a process that trains a part of a scene in blocks, with images on disk. Bytes per pixel of
#: a view: in the coarse run; with the layers around a block. Bytes per Gaussian: of the whole scene
#: in the coarse run; of the whole scene while layers are rendered; of a block, whose region extends
#: beyond its box.
PART_MB = 290
COARSE_PIXEL_BYTES, BLOCK_PIXEL_BYTES = 150, 240
COARSE_GAUSSIAN_BYTES, SCENE_GAUSSIAN_BYTES, BLOCK_GAUSSIAN_BYTES = 900, 450, 2200
#: A job may use this many times its estimate.
MEMORY_MARGIN = 1.25
#: The share of the machine's memory that is left to other programs.
OTHERS_SHARE = 0.25


def memory_mb(pixels: int, gaussians: int) -> int:
    """The estimated peak memory of training in MB.

    Args:
        pixels: The total number of pixels of the views that are kept in memory.
        gaussians: The maximum number of Gaussians.
    """
    return round(PROGRAM_MB + (PIXEL_BYTES * pixels + GAUSSIAN_BYTES * gaussians) / 1e6)


def gaussians_in(megabytes: int, pixels: int) -> int:
    """The number of Gaussians that can be trained in this memory; the inverse of ``memory_mb``."""
    available = (megabytes - PROGRAM_MB) * 1e6 - PIXEL_BYTES * pixels
    return max(0, int(available / GAUSSIAN_BYTES))


def machine_mb() -> int:
    """The memory in MB that training may use without ``partition.memory_mb``."""
    return round(usable_memory() / 1e6 * (1 - OTHERS_SHARE))


def coarse_mb(pixels: int, gaussians: int) -> float:
    """The estimated peak memory in MB of the coarse run of a scene in blocks.

    Args:
        pixels: The number of pixels of a view.
        gaussians: The maximum number of Gaussians of the scene.
    """
    return PART_MB + (COARSE_PIXEL_BYTES * pixels + COARSE_GAUSSIAN_BYTES * gaussians) / 1e6


def block_mb(pixels: int, gaussians: int, blocks: int) -> float:
    """The estimated peak memory in MB of training one of ``blocks`` blocks; see ``coarse_mb``."""
    held = max(SCENE_GAUSSIAN_BYTES, BLOCK_GAUSSIAN_BYTES / blocks)
    return PART_MB + (BLOCK_PIXEL_BYTES * pixels + held * gaussians) / 1e6


def in_blocks_mb(pixels: int, gaussians: int, blocks: int) -> float:
    """The estimated peak memory in MB of the largest job that trains a scene in blocks."""
    return max(coarse_mb(pixels, gaussians), block_mb(pixels, gaussians, blocks))


def blocks_in(megabytes: float, pixels: int, gaussians: int) -> int:
    """The smallest number of blocks, 2 or more, that can be trained in this memory; if no number is
    small enough, one that takes the least memory."""
    # More blocks take no less memory.
    most = math.ceil(BLOCK_GAUSSIAN_BYTES / SCENE_GAUSSIAN_BYTES)
    fitting = (n for n in range(2, most + 1) if in_blocks_mb(pixels, gaussians, n) <= megabytes)
    return next(fitting, most)
