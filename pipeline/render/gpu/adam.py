"""The optimiser's kernels, and their uniforms with the bias corrections of a step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

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
    lr = np.array(_corrected(rates), np.float32)
    space.run(
        "adam.rows" if shared else "adam.elements",
        blocks(count),
        adam=uniform(space, f"Adam of {name}", rates, count, width=width, at=at),
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
    adam = uniform(space, "Adam of frames", rates, count)
    space.run("frame_adam", blocks(count), adam=adam, **buffers)


def optimise(
    space: Workspace,
    rates: Mapping[str, AdamRates],
    count: int,
    half_size: tuple[float, float],
    *,
    moments: Mapping[str, Buffer],
    **buffers: Buffer,
) -> None:
    """Update log scales, opacities, means and rotations by ``Backend.adam_step`` and
    ``Backend.frame_adam``, and the statistics of density control.

    Args:
        rates: The rates of ``log_scales`` and ``opacity_logits``, and of ``frames``, without which
            means and rotations are not updated. They differ in the learning rates only.
        half_size: Half of the width and height of the image.
        moments: The moments of a parameter ``name`` are ``first name`` and ``second name``.
        buffers: ``gradients``, ``geometry``, ``radii``, ``statistics`` and ``stopped``.
    """
    scales, opacities = rates["log_scales"], rates["opacity_logits"]
    common, frames = rates.get("frames", scales), "frames" in rates
    assert len({replace(each, lr=0.0) for each in (scales, opacities, common)}) == 1
    at, _ = layout.offsets(layout.GRADIENTS, count)["means2d"]
    names = {"scale": "log_scales", "opacity": "opacity_logits"}
    names |= {"mean": "means", "rotation": "quats"} if frames else {}
    options = (layout.FRAMES * frames, at, *half_size, *_corrected(scales), *_corrected(opacities))
    space.run(
        "optimise",
        blocks(count),
        adam=uniform(space, "Adam", common, count),
        options=space.uniform("options of Adam", "II4f", *options),
        **{f"{short}_avg": moments[f"first {name}"] for short, name in names.items()},
        **{f"{short}_avg_sq": moments[f"second {name}"] for short, name in names.items()},
        **buffers,
    )


def uniform(
    space: Workspace,
    name: str,
    rates: AdamRates,
    count: int,
    *,
    width: int = 0,
    at: int = 0,
    flags: int = 0,
) -> Buffer:
    """The buffer of this name with ``Adam`` of adam_rates.wgsl."""
    beta1, beta2, step = rates.beta1, rates.beta2, rates.step
    lr = _corrected(rates)
    to_root = 1 / math.sqrt(1 - beta2**step)
    return space.uniform(
        name, "6I10f", count, width, len(lr), at, flags, step, *[*lr, 0.0][:2],
        beta1, beta2, 1 - beta1, 1 - beta2, rates.eps, to_root, beta1 / math.sqrt(beta2), 0.0,
    )  # fmt: skip


def _corrected(rates: AdamRates) -> list[float]:
    """The learning rates with the bias correction of the first moment."""
    to_rate = 1 / (1 - rates.beta1**rates.step)
    return [rate * to_rate for rate in rates.rates]
