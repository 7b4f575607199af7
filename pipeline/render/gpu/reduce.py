"""Sums over rows, in a fixed order."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.render.gpu import layout
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.types import CameraGradients

BLOCK = 1024  # rows of a workgroup of sum_rows.wgsl


def sum_rows(
    gpu: Gpu, space: Workspace, rows: Buffer, count: int, width: int
) -> NDArray[np.float64]:
    """The sum of ``count`` rows of ``width`` float32."""
    groups = blocks(count, BLOCK)
    sums = space.get(f"sums of rows of {width}", 4 * width * groups)
    space.run("sum_rows", groups, size=gpu.uniform("II", count, width), values=rows, sums=sums)
    found = gpu.read(sums, np.float32, width * groups).reshape(-1, width)
    return found.sum(0, dtype=np.float64)


def camera_gradients(gpu: Gpu, space: Workspace, rows: Buffer, count: int) -> CameraGradients:
    """The sum of the Gaussians' parts (N, ``CAMERA_PARAMETERS``)."""
    total = torch.from_numpy(sum_rows(gpu, space, rows, count, layout.CAMERA_PARAMETERS))
    return CameraGradients(*total.split([3, 3, 2, 2]))
