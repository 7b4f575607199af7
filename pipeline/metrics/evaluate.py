"""Evaluation of a scene: renders of the test views compared with their photographs."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.config.schema import Evaluate, Train
from pipeline.metrics.evaluation import (
    EvaluatedModel,
    Evaluation,
    ProtocolDescription,
    ViewMetrics,
)
from pipeline.metrics.flip import FLIP_VARIANT
from pipeline.metrics.image import SSIM_VARIANT
from pipeline.metrics.lpips import LPIPS_VARIANTS, MIN_SIDE, Lpips, lpips_available
from pipeline.metrics.protocol import Protocol
from pipeline.metrics.rendered import Rendered, ViewRenderer
from pipeline.render.views import to_bytes
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import Progress
from pipeline.scene.appearance import Appearance
from pipeline.scene.exposure import NO_GAINS, ExposureGains
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

#: A mean PSNR of training views below this, in dB, indicates inconsistent photographs or poses.
LOW_TRAIN_PSNR = 22.0
#: Overfitting: the PSNR of training views exceeds that of test views by more than ``LARGE_GAP`` dB,
#: and the latter is below ``LOW_PSNR`` dB.
LARGE_GAP, LOW_PSNR = 6.0, 25.0

#: zlib level of the renders: higher levels are much slower and save little.
PNG_LEVEL = 1

EXPOSURE_PROTOCOL = (
    "renders multiplied by each photograph's gains (one per channel; vignetting and a slope where "
    "modelled), which are measured at the sparse points, in test photographs as well; "
    "psnr_without_gains is without this"
)
VIGNETTING_PROTOCOL = (
    "renders multiplied by the vignetting of each camera, which is measured at the sparse points "
    "of the training photographs"
)
APPEARANCE_PROTOCOL = (
    "the appearance of each test photograph is fitted on its left half and measured on its "
    "right half (NeRF in the Wild); psnr_without_fit is of the scene's own colours on the same half"
)
POSES_PROTOCOL = (
    "the pose of each test camera is optimised on its photograph, with the scene held fixed"
)
POSES_OF_ALL = "from all photographs, test views included (as usual in the field)"
POSES_OF_SPLIT = "poses are given; points are given or from the training photographs alone"


class _Measured(NamedTuple):
    """The measures of a view, and its PSNR without its fitted appearance; None where it has
    none."""

    record: ViewMetrics
    without_fit: float | None
    is_masked: bool


def evaluate_views(
    gaussians: Gaussians,
    protocol: Protocol,
    config: Evaluate,
    train: Train,
    out: Path,
    *,
    gains: ExposureGains = NO_GAINS,
    appearance: Appearance | None = None,
    threads: int,
) -> Evaluation:
    """Render each view, write it as 8-bit PNG, and compare that image with the photograph.

    Args:
        gains: The exposure gains of all views of the protocol, by which renders are multiplied;
            empty if exposure is not modelled.
        appearance: The appearance of the Gaussians in photographs; None if it is not modelled.
            Views without an embedding of their own get one that is fitted on their left half, and
            are measured on the right half.
        out: The folder for the renders, ``<index>.png`` in the order of the views.

    Returns:
        The measures and their protocol, without ``pose_error``.

    Raises:
        UserError: the masks hide all views.
    """
    renderer = ViewRenderer(gaussians, protocol, train, gains, appearance, threads)
    lpips, reason = lpips_available(config.lpips_net)
    if lpips is not None and (smallest := renderer.smallest_side()) < MIN_SIDE:
        lpips, reason = None, f"views of {smallest} px are too small, {MIN_SIDE} px are needed"
    out.mkdir(parents=True, exist_ok=True)
    progress = Progress("evaluating", len(protocol.views) + len(protocol.training_views), "views")
    warnings: list[str] = []
    measured = _measure(renderer, lpips, out, threads, progress, warnings)
    training: list[float] = []
    for view in protocol.training_views:
        found = renderer.render(view)
        if not found.is_hidden:
            training.append(found.psnr(renderer.with_exposure(found.rgb, view)))
        progress.advance()
    if not measured:
        raise UserError("the masks leave no pixel of any view to measure", fix="check masks/")
    per_view = tuple(view.record for view in measured)
    psnr = float(np.mean([view.psnr for view in per_view]))
    train_psnr = _mean(training)
    if train_psnr is not None:
        warnings += diagnose(psnr, train_psnr)
    without_fit = _mean([view.without_fit for view in measured])
    return Evaluation(
        psnr=psnr,
        train_psnr=train_psnr,
        psnr_without_gains=_mean([view.psnr_without_gains for view in per_view]),
        psnr_without_fit=without_fit,
        ssim=float(np.mean([view.ssim for view in per_view])),
        flip=_mean([view.flip for view in per_view]),
        lpips=_mean([view.lpips for view in per_view]),
        lpips_reason=reason,
        per_view=per_view,
        protocol=ProtocolDescription(
            resolution=_sizes(protocol.views),
            split=_describe_split(protocol),
            poses_and_points=POSES_OF_SPLIT if protocol.listed else POSES_OF_ALL,
            num_views=len(per_view),
            num_photographs=_split_photographs(protocol.views),
            psnr="mean over the views of PSNR in dB, 8-bit renders, peak 1",
            ssim=SSIM_VARIANT,
            flip=FLIP_VARIANT,
            lpips=LPIPS_VARIANTS[config.lpips_net] if lpips is not None else reason,
            masks=_describe_masks(protocol, measured),
            background=protocol.background,
            exposure=_describe_exposure(gains, appearance),
            appearance=APPEARANCE_PROTOCOL if without_fit is not None else None,
            poses=POSES_PROTOCOL if train.refine_poses else None,
        ),
        model=EvaluatedModel(num_gaussians=len(gaussians), sh_degree=gaussians.sh_degree),
        warnings=tuple(warnings),
    )


def _measure(
    renderer: ViewRenderer,
    lpips: Lpips | None,
    out: Path,
    threads: int,
    progress: Progress,
    warnings: list[str],
) -> list[_Measured]:
    """Measure the views of the protocol. Views that their masks hide are left out, with a message
    in ``warnings``."""
    # Views are measured while the next ones are rendered. The queue is short: it holds the images.
    pending: deque[Future[_Measured]] = deque()
    measured: list[_Measured] = []

    def collect() -> None:
        measured.append(pending.popleft().result())
        progress.advance(note=f"PSNR {measured[-1].record.psnr:.2f} dB")

    with ThreadPoolExecutor(max(threads, 1)) as pool:
        for index, view in enumerate(renderer.protocol.views):
            found = renderer.render(view)
            if found.is_hidden:
                warnings.append(f"{view.name}: its mask leaves no pixel to measure")
                progress.advance()
                continue
            file = out / f"{index:04d}.png"
            image = renderer.with_exposure(found.rgb, view)
            distance = None if lpips is None else found.distance(image, lpips)
            # With an appearance of their own, photographs have no gain among the view's gains.
            has_gain = bool(renderer.gains) and renderer.appearance is None
            pending.append(pool.submit(_compare, found, image, distance, file, has_gain))
            if len(pending) > threads:
                collect()
        while pending:
            collect()
    return measured


def _compare(
    found: Rendered,
    image: NDArray[np.uint8],
    lpips: float | None,
    file: Path,
    has_gain: bool,
) -> _Measured:
    """Write ``image``, the render with the exposure of its photograph, and compare it with that.

    Args:
        has_gain: Whether the render was multiplied by a gain.
    """
    Image.fromarray(image).save(file, compress_level=PNG_LEVEL)
    record = ViewMetrics(
        name=found.view,
        psnr=found.psnr(image),
        ssim=found.ssim(image),
        flip=found.flip(image),
        lpips=lpips,
        psnr_without_gains=found.psnr(to_bytes(found.rgb)) if has_gain else None,
        render=file.name,
    )
    without_fit = None if found.own is None else found.psnr(to_bytes(found.own))
    return _Measured(record, without_fit, found.is_masked)


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean of the values that are known; None without one."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def diagnose(test_psnr: float, train_psnr: float) -> list[str]:
    """Warnings about inconsistent photographs or overfitting, from mean PSNR in dB."""
    if train_psnr < LOW_TRAIN_PSNR:
        return [
            f"the scene reproduces its training photographs badly ({train_psnr:.1f} dB). Possible "
            "causes: exposure or season changes between photographs, moving objects, unmasked "
            "backgrounds, wrong poses, very short training. Compare the views in the report"
        ]
    if test_psnr < LOW_PSNR and train_psnr - test_psnr > LARGE_GAP:
        return [
            f"test views are much worse than training views ({test_psnr:.1f} against "
            f"{train_psnr:.1f} dB): there are too few photographs, or they are too far apart"
        ]
    return []


def _describe_exposure(gains: ExposureGains, appearance: Appearance | None) -> str | None:
    if not gains:
        return None
    return EXPOSURE_PROTOCOL if appearance is None else VIGNETTING_PROTOCOL


def _describe_masks(protocol: Protocol, measured: Sequence[_Measured]) -> str | None:
    if all(view.mask is None for view in protocol.views):
        return None
    # A view whose mask excludes all pixels is not measured.
    if len(measured) < len(protocol.views) or any(view.is_masked for view in measured):
        return "masked pixels are excluded"
    return "the masks exclude no pixel of the measured views"


def _split_photographs(views: Sequence[View]) -> int | None:
    """Number of photographs that the views are parts of; None if each view is a photograph."""
    if all(view.source is None for view in views):
        return None
    return len({view.source or view.name for view in views})


def _sizes(views: Sequence[View]) -> tuple[str, ...]:
    sizes = sorted({(view.width, view.height) for view in views})
    return tuple(f"{w}x{h}" for w, h in sizes)


def _describe_split(protocol: Protocol) -> str:
    if protocol.listed and protocol.train_views is not None:
        return (
            f"{protocol.num_training} training views (split.train_views) and {len(protocol.views)} "
            "test views; other photographs are not used"
        )
    if protocol.listed:
        return (
            f"test views: the scene's own split, listed with its poses: {protocol.num_training} "
            f"training views, {len(protocol.views)} test views"
        )
    if not protocol.every:
        return "no test views: measured on the TRAINING views"
    if _split_photographs(protocol.views) is not None:
        return f"test views: all of one photograph in {protocol.every}, sorted by name"
    return f"test views: one view in {protocol.every}, sorted by name, from the first"
