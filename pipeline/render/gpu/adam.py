"""The uniforms of the optimiser's kernels, with the bias corrections of a step."""

from __future__ import annotations

import math

import numpy as np
import torch

from pipeline.render.gpu import layout
from pipeline.render.gpu.device import Buffer
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.types import DenseAdam, FrameAdam, ShAdam


def adam_uniform(
    space: Workspace, name: str, adam: DenseAdam, count: int, width: int, at: int = 0
) -> tuple[Buffer, Buffer]:
    """``Adam`` of adam.wgsl for ``count`` elements or rows of ``width``, and the rates.

    Args:
        name: of the parameter.
        at: the first element in the arrays of parameters and gradients.
    """
    to_rate, to_root = corrections(adam)
    rates = torch.atleast_1d(torch.tensor(adam.lr, dtype=torch.float64)) * to_rate
    sizes = count, width, len(rates), at
    uniform = space.uniform(
        f"Adam of {name}", "4I6fIf", *sizes, *decay(adam), adam.eps, to_root, at, 0.0
    )
    packed = rates.numpy().astype(np.float32).tobytes()
    return uniform, space.write_uniform(f"rates of {name}", packed)


def frame_uniform(space: Workspace, adam: FrameAdam, count: int) -> Buffer:
    """``Adam`` of frame_adam.wgsl."""
    to_rate, to_root = corrections(adam)
    rates = adam.mean_rate * to_rate, adam.rotation_rate * to_rate
    return space.uniform(
        "Adam of frames", "I9f8x", count, *rates, adam.eps, *decay(adam), to_root, 0.0
    )


def sh_options(space: Workspace, adam: ShAdam | None, camera: bool) -> Buffer:
    """``Options`` of project_backward.wgsl."""
    flags = layout.CAMERA * camera
    if adam is None:
        return space.uniform("options of SH", "II10f", flags, *[0] * 11)
    to_rate, to_root = corrections(adam)
    rates = adam.dc_rate * to_rate, adam.rate * to_rate
    ratio = adam.beta1 / math.sqrt(adam.beta2)
    flags |= layout.SH_ADAM
    values = flags, adam.step, *rates, *decay(adam), adam.eps, to_root, ratio, 0.0
    return space.uniform("options of SH", "II10f", *values)


def corrections(adam: DenseAdam | FrameAdam | ShAdam) -> tuple[float, float]:
    """Bias corrections: factors of the learning rates and of the root of the second moment."""
    return 1 / (1 - adam.beta1**adam.step), 1 / math.sqrt(1 - adam.beta2**adam.step)


def decay(adam: DenseAdam | FrameAdam | ShAdam) -> tuple[float, float, float, float]:
    """beta1, beta2, 1 - beta1, 1 - beta2."""
    return adam.beta1, adam.beta2, 1 - adam.beta1, 1 - adam.beta2
