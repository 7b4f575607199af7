"""Held-out views against their photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.config.schema import Evaluate, Split, Train
from pipeline.metrics.image import SSIM_VARIANT, psnr, ssim
from pipeline.metrics.lpips import LPIPS_VARIANTS, MIN_SIDE, lpips_available
from pipeline.photos.load import ViewPixels, load_view
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import Progress
from pipeline.scene.model import View
from pipeline.scene.views import scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training.render import near_plane, render_view

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Protocol:
    """How quality was measured; the same for every view of a scene.

    Attributes:
        views: those measured on.
        every: each this-many-th view was held out of training; 0: none was, these were seen.
        background: RGB in [0, 1] behind renders and transparent photographs.
        near: near plane of the renders, as in training; world unit.
    """

    views: list[View]
    every: int
    background: tuple[float, float, float]
    near: float


def choose_protocol(views: Sequence[View], split: Split, train: Train) -> Protocol:
    """The views to evaluate on (the held-out ones, else all) and the background.

    The background is the one trained on; where that was random (images with alpha), white, as
    the field does for NeRF-synthetic scenes.
    """
    held_out = [view for view in views if view.is_test]
    white = train.background in ("white", "random")
    return Protocol(
        held_out or list(views),
        split.holdout_every if held_out else 0,
        WHITE if white else BLACK,
        near_plane(scene_extent(list(views))),
    )


def evaluate_views(
    gaussians: Gaussians,
    protocol: Protocol,
    config: Evaluate,
    train: Train,
    out: Path,
    *,
    threads: int,
) -> dict[str, Any]:
    """Render each view, save it as 8-bit PNG, and measure that picture.

    Args:
        out: folder for the renders, ``<index>.png`` in the order of the views.

    Returns:
        ``psnr``, ``ssim``, ``lpips`` (means of the views' values; lpips null where its weights are
        missing, with ``lpips_reason``), ``per_view``, ``warnings`` and ``protocol``.
    """
    lpips, reason = lpips_available(config.lpips_net)
    smallest = min(min(view.width, view.height) for view in protocol.views)
    if lpips is not None and smallest < MIN_SIDE:
        lpips, reason = None, f"views of {smallest} px are too small, {MIN_SIDE} px are needed"
    out.mkdir(parents=True, exist_ok=True)
    per_view: list[dict[str, Any]] = []
    progress = Progress("evaluating", len(protocol.views), "views")
    warnings: list[str] = []
    for index, view in enumerate(protocol.views):
        pixels = load_view(view.image, view.mask, view.width, view.height)
        if pixels.mask is not None and not pixels.mask.any():
            warnings.append(f"{view.name}: its mask leaves no pixel to measure")
            progress.advance()
            continue
        rendered = render_view(
            gaussians,
            view,
            background=protocol.background,
            sh_degree=train.sh_degree,
            antialias=train.antialias,
            near=protocol.near,
            threads=threads,
        )
        picture = to_bytes(rendered.rgb)
        Image.fromarray(picture).save(out / f"{index:04d}.png")
        a, b = picture / 255.0, reference(pixels, protocol.background) / 255.0
        per_view.append(
            {
                "name": view.name,
                "psnr": psnr(a, b, pixels.mask),
                "ssim": ssim(a, b, pixels.mask),
                "lpips": lpips(a, b, pixels.mask) if lpips is not None else None,
                "render": f"{index:04d}.png",
            }
        )
        progress.advance(note=f"PSNR {per_view[-1]['psnr']:.2f} dB")
    if not per_view:
        raise UserError("the masks leave no pixel of any view to measure", fix="check masks/")
    return {
        "psnr": float(np.mean([v["psnr"] for v in per_view])),
        "ssim": float(np.mean([v["ssim"] for v in per_view])),
        "lpips": None if lpips is None else float(np.mean([v["lpips"] for v in per_view])),
        "lpips_reason": reason,
        "per_view": per_view,
        "warnings": warnings,
        "protocol": _describe(protocol, config, len(per_view), reason if lpips is None else None),
    }


def reference(pixels: ViewPixels, background: tuple[float, float, float]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 photograph, over the background where it has alpha."""
    if pixels.alpha is None:
        return pixels.rgb
    alpha = pixels.alpha[..., None] / 255.0
    return to_bytes(pixels.rgb / 255.0 * alpha + np.array(background) * (1 - alpha))


def to_bytes(image: Any) -> NDArray[np.uint8]:
    """[0, 1] floats to 8 bit, rounded."""
    return np.rint(np.clip(np.asarray(image), 0, 1) * 255).astype(np.uint8)


def _describe(
    protocol: Protocol, config: Evaluate, num_views: int, no_lpips: str | None
) -> dict[str, Any]:
    sizes = sorted({(view.width, view.height) for view in protocol.views})
    return {
        "resolution": [f"{w}x{h}" for w, h in sizes],
        "split": (
            f"held out: one view in {protocol.every}, sorted by name, from the first"
            if protocol.every
            else "no view was held out: measured on the TRAINING views"
        ),
        "poses_and_points": "from all photographs, the held-out ones included (the field's habit)",
        "num_views": num_views,
        "psnr": "mean of the views' PSNR in dB, 8-bit renders, peak 1",
        "ssim": SSIM_VARIANT,
        "lpips": no_lpips or LPIPS_VARIANTS[config.lpips_net],
        "masks": "masked pixels count for nothing" if any(v.mask for v in protocol.views) else None,
        "background": list(protocol.background),
    }
