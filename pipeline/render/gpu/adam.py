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
    gradient_at: int = 0,
    moments_at: int = 0,
    **buffers: Buffer,
) -> None:
    """Update a parameter (N, width) by ``Backend.adam_step``.

    Args:
        name: The parameter's name, which the workspace's buffers get.
        shared: Each row has one second moment.
        at, gradient_at, moments_at: The first elements of the parameter, of its gradient and of its
            moments in their buffers.
        buffers: ``parameter``, ``gradient`` and ``moments``, the first before the second.
    """
    rows, width = shape
    count = rows if shared else rows * width
    lr = np.array(_corrected(rates), np.float32)
    space.run(
        "adam.rows" if shared else "adam.elements",
        blocks(count),
        adam=uniform(
            space, f"Adam of {name}", rates, count, width=width, at=(at, gradient_at, moments_at)
        ),
        rates=space.write_uniform(f"rates of {name}", lr.tobytes()),
        **buffers,
    )


def frame_adam(space: Workspace, rates: AdamRates, count: int, **buffers: Buffer) -> None:
    """Update ``count`` means and rotations by ``Backend.frame_adam``.

    Args:
        buffers: ``geometry``, whose first sections are means, log scales and quaternions,
            ``gradients`` of means and quaternions, and ``moments``, the first and the second of
            means and then of rotations.
    """
    adam = uniform(space, "Adam of frames", rates, count)
    space.run("frame_adam", blocks(count), adam=adam, **buffers)


def update_gaussians(
    space: Workspace,
    rates: Mapping[str, AdamRates],
    count: int,
    half_size: tuple[float, float],
    written: Mapping[str, int],
    **buffers: Buffer,
) -> None:
    """Differentiate the projection, and update SH coefficients, log scales, opacities, means and
    rotations by ``ShAdam``, ``Backend.adam_step`` and ``Backend.frame_adam``, and the statistics of
    density control.

    Args:
        rates: The rates of ``sh``, ``log_scales`` and ``opacity_logits``, and of ``frames``,
            without which means and rotations are not updated. They differ in the learning rates
            only.
        half_size: Half of the width and height of the image.
        written: The sections of ``gradients``, see ``layout.written_gradients``.
        buffers: Those of update_gaussians.wgsl.
    """
    scales, opacities, sh = (rates[name] for name in ("log_scales", "opacity_logits", "sh"))
    common = rates.get("frames", scales)
    assert len({replace(each, lr=0.0) for each in (scales, opacities, sh, common)}) == 1
    at = layout.offsets(written, count)
    flags = layout.FRAMES * ("frames" in rates)
    flags |= layout.CAMERA * ("camera" in written) | layout.COLORS * ("colors" in written)
    starts = (at.get(name, (0, 0))[0] for name in ("colors", "means", "quats"))
    corrected = (rate for each in (sh, scales, opacities) for rate in _corrected(each))
    space.run(
        "update_gaussians",
        blocks(count),
        adam=uniform(space, "Adam", common, count),
        options=space.uniform("options of Adam", "4I6f", flags, *starts, *half_size, *corrected),
        **buffers,
    )


def uniform(
    space: Workspace,
    name: str,
    rates: AdamRates,
    count: int,
    *,
    width: int = 0,
    at: tuple[int, int, int] = (0, 0, 0),
    flags: int = 0,
) -> Buffer:
    """The buffer of this name with ``Adam`` of adam_rates.wgsl."""
    beta1, beta2, step = rates.beta1, rates.beta2, rates.step
    lr = _corrected(rates)
    to_root = 1 / math.sqrt(1 - beta2**step)
    return space.uniform(
        name, "8I9f", count, width, len(lr), *at, flags, step, *[*lr, 0.0][:2],
        beta1, beta2, 1 - beta1, 1 - beta2, rates.eps, to_root, beta1 / math.sqrt(beta2),
    )  # fmt: skip


def _corrected(rates: AdamRates) -> list[float]:
    """The learning rates with the bias correction of the first moment."""
    to_rate = 1 / (1 - rates.beta1**rates.step)
    return [rate * to_rate for rate in rates.rates]
