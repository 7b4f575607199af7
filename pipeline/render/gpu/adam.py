"""The optimiser's kernels, and their uniforms with the bias corrections of a step."""

from __future__ import annotations

import math

import numpy as np

from pipeline.render.gpu import layout
from pipeline.render.gpu.device import Buffer, blocks
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.types import AdamRates


def adam_step(
    space: Workspace,
    name: str,
    rates: AdamRates,
    shape: tuple[int, int],
    *,
    shared: bool,
    at: int = 0,
    **buffers: Buffer,
) -> None:
    """Update a parameter (N, width) by ``Backend.adam_step``.

    Args:
        name: The parameter's name, which the workspace's buffers get.
        shared: Each row has one second moment.
        at: The first element of the parameter and of its gradient in their buffers.
        buffers: ``parameter``, ``gradient``, ``exp_avg`` and ``exp_avg_sq``.
    """
    rows, width = shape
    count = rows if shared else rows * width
    to_rate, to_root = _corrections(rates)
    lr = np.array([rate * to_rate for rate in rates.rates], np.float32)
    sizes = count, width, len(lr), at
    space.run(
        "adam.rows" if shared else "adam.elements",
        blocks(count),
        adam=space.uniform(
            f"Adam of {name}", "4I6fIf", *sizes, *_decay(rates), rates.eps, to_root, at, 0.0
        ),
        rates=space.write_uniform(f"rates of {name}", lr.tobytes()),
        **buffers,
    )


def frame_adam(space: Workspace, rates: AdamRates, count: int, **buffers: Buffer) -> None:
    """Update ``count`` means and rotations by ``Backend.frame_adam``.

    Args:
        buffers: ``geometry`` and ``gradients``, whose first sections are means, log scales and
            quaternions, and the moments ``mean_avg``, ``mean_avg_sq``, ``rotation_avg`` and
            ``rotation_avg_sq``.
    """
    to_rate, to_root = _corrections(rates)
    lr = [rate * to_rate for rate in rates.rates]
    values = count, *lr, rates.eps, *_decay(rates), to_root, 0.0
    uniform = space.uniform("Adam of frames", "I9f8x", *values)
    space.run("frame_adam", blocks(count), adam=uniform, **buffers)


def sh_options(space: Workspace, rates: AdamRates | None, camera: bool) -> Buffer:
    """``Options`` of project_backward.wgsl."""
    flags = layout.CAMERA * camera
    if rates is None:
        return space.uniform("options of SH", "II10f", flags, *[0] * 11)
    to_rate, to_root = _corrections(rates)
    lr = [rate * to_rate for rate in rates.rates]
    ratio = rates.beta1 / math.sqrt(rates.beta2)
    flags |= layout.SH_ADAM
    values = flags, rates.step, *lr, *_decay(rates), rates.eps, to_root, ratio, 0.0
    return space.uniform("options of SH", "II10f", *values)


def _corrections(rates: AdamRates) -> tuple[float, float]:
    """The bias corrections: factors of the learning rates and of the root of the second moment."""
    return 1 / (1 - rates.beta1**rates.step), 1 / math.sqrt(1 - rates.beta2**rates.step)


def _decay(rates: AdamRates) -> tuple[float, float, float, float]:
    """beta1, beta2, 1 - beta1, 1 - beta2."""
    return rates.beta1, rates.beta2, 1 - rates.beta1, 1 - rates.beta2
