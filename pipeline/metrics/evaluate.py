"""Held-out views against their photographs."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.config.schema import Evaluate, Split, Train
from pipeline.metrics.image import SSIM_VARIANT, psnr, ssim
from pipeline.metrics.lpips import LPIPS_VARIANTS, MIN_SIDE, lpips_available
from pipeline.photos.load import ViewPixels, load_view
from pipeline.render import RasterOptions
from pipeline.render.views import near_plane, render_rgb, to_bytes
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import Progress
from pipeline.scene.views import View, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training.cameras.fit_pose import fit_pose

#: Training views that are rendered, too: what the model makes of pictures that it has seen.
NUM_SEEN = 8
#: Below this many dB on seen views the photographs contradict each other or the poses: scenes that
#: train well reach 25 to 40 dB.
LOW_SEEN_PSNR = 22.0
#: This many dB between seen and held-out views, where these are bad, is overfitting: well-covered
#: scenes show 0 to 4.
LARGE_GAP, LOW_PSNR = 6.0, 25.0

#: Of zlib, for the renders: higher ones take several times as long for a tenth of the size.
PNG_LEVEL = 1

NO_GAINS: Mapping[str, Sequence[float]] = MappingProxyType({})
EXPOSURE_PROTOCOL = (
    "renders multiplied by each photograph's gains (one a channel), which were measured at the "
    "sparse points, in held-out photographs too; psnr_without_gains is as rendered"
)
POSES_PROTOCOL = (
    "each held-out camera moved to where the scene, which stays as it is, fits its photograph best"
)
Mask = NDArray[np.bool_]

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Protocol:
    """How quality was measured; the same for every view of a scene.

    Attributes:
        views: those measured on.
        seen: training views measured beside them, evenly spread; empty where ``every`` is 0.
        every: each this-many-th view was held out of training; 0: none was, these were seen.
        background: RGB in [0, 1] behind renders and transparent photographs.
        near: near plane of the renders, as in training; world unit.
        extent: the scene's size, world unit.
    """

    views: list[View]
    seen: list[View]
    every: int
    background: tuple[float, float, float]
    near: float
    extent: float

    def options(self, train: Train, threads: int) -> RasterOptions:
        """How its renders are drawn: as in training, over ``background``."""
        return RasterOptions(
            sh_degree=train.sh_degree,
            background=self.background,
            antialias=train.antialias,
            near=self.near,
            threads=threads,
        )


def choose_protocol(views: Sequence[View], split: Split, train: Train) -> Protocol:
    """The views to evaluate on (the held-out ones, else all) and the background.

    The background is the one trained on; where that was random (images with alpha), white, as
    the field does for NeRF-synthetic scenes.
    """
    held_out = [view for view in views if view.is_test]
    training = [view for view in views if not view.is_test]
    picks = np.linspace(0, len(training) - 1, min(NUM_SEEN, len(training))).round().astype(int)
    white = train.background in ("white", "random")
    extent = scene_extent(list(views))
    return Protocol(
        held_out or list(views),
        [training[i] for i in picks] if held_out else [],
        split.holdout_every if held_out else 0,
        WHITE if white else BLACK,
        near_plane(extent),
        extent,
    )


def evaluate_views(
    gaussians: Gaussians,
    protocol: Protocol,
    config: Evaluate,
    train: Train,
    out: Path,
    *,
    gains: Mapping[str, Sequence[float]] = NO_GAINS,
    threads: int,
) -> dict[str, Any]:
    """Render each view, save it as 8-bit PNG, and measure that picture.

    Args:
        gains: by view's name, each channel's factor from the scene's typical exposure to the
            view's; empty where views are exposed alike.
        out: folder for the renders, ``<index>.png`` in the order of the views.

    Returns:
        ``psnr``, ``ssim``, ``lpips`` (means of the views' values; lpips null where its weights are
        missing, with ``lpips_reason``), ``train_psnr`` (mean over the seen views, null without
        any), ``psnr_without_gains`` (null where there are none), ``per_view``, ``warnings`` and
        ``protocol``.
    """
    lpips, reason = lpips_available(config.lpips_net)
    smallest = min(min(view.width, view.height) for view in protocol.views)
    if lpips is not None and smallest < MIN_SIDE:
        lpips, reason = None, f"views of {smallest} px are too small, {MIN_SIDE} px are needed"
    out.mkdir(parents=True, exist_ok=True)
    per_view: list[dict[str, Any]] = []
    progress = Progress("evaluating", len(protocol.views) + len(protocol.seen), "views")
    warnings: list[str] = []
    without: list[float] = []
    options = protocol.options(train, threads)

    def compare(view: View) -> tuple[NDArray[np.float32], NDArray[np.uint8], Mask | None]:
        pixels = load_view(view)
        photo = reference(pixels, protocol.background)
        if train.refine_poses and view.is_test:
            gain, weight = gains.get(view.name), train.ssim_weight
            view = fit_pose(
                gaussians, view, photo, pixels.mask, gain, options, protocol.extent, weight
            )
        return render_rgb(gaussians, view, options), photo, pixels.mask

    def exposed(rgb: NDArray[np.float32], view: View) -> NDArray[np.uint8]:
        return to_bytes(rgb * np.array(gains[view.name], np.float32) if gains else rgb)

    def measure(
        index: int, rgb: NDArray[np.float32], photo: NDArray[np.uint8], mask: Mask | None
    ) -> tuple[dict[str, Any], float | None]:
        view = protocol.views[index]
        picture = exposed(rgb, view)
        name = f"{index:04d}.png"
        Image.fromarray(picture).save(out / name, compress_level=PNG_LEVEL)
        a, b = picture / 255.0, photo / 255.0
        record = {"name": view.name, "psnr": psnr(a, b, mask), "ssim": ssim(a, b, mask)}
        record |= {"lpips": None, "render": name}
        return record, psnr(to_bytes(rgb) / 255.0, b, mask) if gains else None

    def collect(found: Future[tuple[dict[str, Any], float | None]]) -> None:
        record, plain = found.result()
        per_view.append(record)
        if plain is not None:
            without.append(plain)
        progress.advance(note=f"PSNR {record['psnr']:.2f} dB")

    # Views are measured beside the rendering of the next ones; few, as each holds its pictures.
    pending: deque[Future[tuple[dict[str, Any], float | None]]] = deque()
    distances: list[float] = []
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        for index, view in enumerate(protocol.views):
            rgb, photo, mask = compare(view)
            if _hidden(mask):
                warnings.append(f"{view.name}: its mask leaves no pixel to measure")
                progress.advance()
                continue
            pending.append(pool.submit(measure, index, rgb, photo, mask))
            if lpips is not None:
                distances.append(lpips(exposed(rgb, view) / 255.0, photo / 255.0, mask))
            if len(pending) > threads:
                collect(pending.popleft())
        while pending:
            collect(pending.popleft())
    for record, distance in zip(per_view, distances, strict=lpips is not None):
        record["lpips"] = distance
    seen: list[float] = []
    for view in protocol.seen:
        rgb, photo, mask = compare(view)
        if not _hidden(mask):
            seen.append(psnr(exposed(rgb, view) / 255.0, photo / 255.0, mask))
        progress.advance()
    if not per_view:
        raise UserError("the masks leave no pixel of any view to measure", fix="check masks/")
    mean_psnr = float(np.mean([v["psnr"] for v in per_view]))
    train_psnr = float(np.mean(seen)) if seen else None
    if train_psnr is not None:
        warnings += diagnose(mean_psnr, train_psnr)
    return {
        "psnr": mean_psnr,
        "train_psnr": train_psnr,
        "psnr_without_gains": float(np.mean(without)) if gains else None,
        "ssim": float(np.mean([v["ssim"] for v in per_view])),
        "lpips": None if lpips is None else float(np.mean([v["lpips"] for v in per_view])),
        "lpips_reason": reason,
        "per_view": per_view,
        "warnings": warnings,
        "protocol": _describe(protocol, config, len(per_view), reason if lpips is None else None)
        | {"exposure": EXPOSURE_PROTOCOL if gains else None}
        | {"poses": POSES_PROTOCOL if train.refine_poses else None},
    }


def diagnose(held_out: float, seen: float) -> list[str]:
    """Warnings for what mean PSNR (dB) on held-out and on seen views says of a bad scene."""
    if seen < LOW_SEEN_PSNR:
        return [
            f"the scene reproduces the photographs it was trained on badly ({seen:.1f} dB): "
            "look at the report's views; photographs that differ in exposure or season, things "
            "that move, unmasked backgrounds, wrong poses and very short training do this"
        ]
    if held_out < LOW_PSNR and seen - held_out > LARGE_GAP:
        return [
            f"views held out are much worse than views trained on ({held_out:.1f} against "
            f"{seen:.1f} dB): too few photographs, too far apart, see some places only once"
        ]
    return []


def _hidden(mask: Mask | None) -> bool:
    return mask is not None and not mask.any()


def reference(pixels: ViewPixels, background: tuple[float, float, float]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 photograph, over the background where it has alpha."""
    if pixels.alpha is None:
        return pixels.rgb
    alpha = pixels.alpha[..., None] / 255.0
    return to_bytes(pixels.rgb / 255.0 * alpha + np.array(background) * (1 - alpha))


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
