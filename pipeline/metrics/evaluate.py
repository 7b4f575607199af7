"""Evaluation of a scene: renders of the test views compared with their photographs."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

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
from pipeline.metrics.image import SSIM_VARIANT, psnr, ssim
from pipeline.metrics.lpips import LPIPS_VARIANTS, MIN_SIDE, lpips_available
from pipeline.metrics.protocol import Protocol
from pipeline.photos.load import load_view
from pipeline.render.views import render_rgb, to_bytes
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import Progress
from pipeline.scene.appearance import Appearance, fitted_columns
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
    "renders multiplied by each photograph's gains (one per channel), which are measured at the "
    "sparse points, in test photographs as well; psnr_without_gains is without this"
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
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Rendered:
    """A render and its photograph.

    Attributes:
        rgb: (H, W, 3) float32.
        own: the same in the scene's own colours; None if the appearance was not fitted.
        photo: (H, W, 3) uint8.
        mask: (H, W), False for ignored pixels; None if there are none.
    """

    rgb: NDArray[np.float32]
    own: NDArray[np.float32] | None
    photo: NDArray[np.uint8]
    mask: Mask | None

    @property
    def columns(self) -> slice:
        """The measured columns: the right half if the appearance was fitted on the left one."""
        return slice(0 if self.own is None else fitted_columns(self.photo.shape[1]), None)

    @property
    def measured_mask(self) -> Mask | None:
        return None if self.mask is None else self.mask[:, self.columns]

    def psnr(self, image: NDArray[np.uint8]) -> float:
        """PSNR of an image over the measured columns."""
        here = self.columns
        return psnr(image[:, here], self.photo[:, here], self.measured_mask)

    def ssim(self, image: NDArray[np.uint8]) -> float:
        """SSIM of an image over the measured columns."""
        here = self.columns
        return ssim(image[:, here], self.photo[:, here], self.measured_mask)


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
        gains: of all views of the protocol, by which renders are multiplied; empty if exposure is
            not modelled.
        appearance: of the Gaussians in photographs; None if it is not modelled. Views without an
            embedding of their own get one that is fitted on their left half, and are measured on
            the right half.
        out: folder for the renders, ``<index>.png`` in the order of the views.

    Returns:
        The measures and their protocol, without ``pose_error``.

    Raises:
        UserError: the masks hide all views.
    """
    lpips, reason = lpips_available(config.lpips_net)
    fitted = {view.name for view in protocol.views} if appearance else set()
    if appearance:
        fitted -= appearance.embeddings.keys()
    smallest = min(
        min(
            view.height,
            view.width - (fitted_columns(view.width) if view.name in fitted else 0),
        )
        for view in protocol.views
    )
    if lpips is not None and smallest < MIN_SIDE:
        lpips, reason = None, f"views of {smallest} px are too small, {MIN_SIDE} px are needed"
    out.mkdir(parents=True, exist_ok=True)
    per_view: list[ViewMetrics] = []
    progress = Progress("evaluating", len(protocol.views) + len(protocol.training_views), "views")
    warnings: list[str] = []
    unadjusted: list[float] = []
    unfitted: list[float] = []
    options = protocol.options(train, threads)

    def render_and_load(view: View) -> Rendered:
        pixels = load_view(view)
        photo, shown, own = pixels.over(protocol.background), gaussians, None
        if appearance is not None:
            from pipeline.training.appearance.fit import in_photograph

            shown = in_photograph(gaussians, appearance, view, photo, pixels.mask, options)
        if train.refine_poses and view.is_test:
            from pipeline.training.cameras.fit_pose import fit_pose

            gain, weight = gains.of(view.name), train.ssim_loss_weight
            view = fit_pose(shown, view, photo, pixels.mask, gain, options, protocol.extent, weight)
        if view.name in fitted:
            own = render_rgb(gaussians, view, options)
        return Rendered(render_rgb(shown, view, options), own, photo, pixels.mask)

    def with_exposure(rgb: NDArray[np.float32], view: View) -> NDArray[np.uint8]:
        gain = gains.of(view.name)
        return to_bytes(rgb if gain is None else rgb * np.array(gain, np.float32))

    def measure(index: int, found: Rendered) -> tuple[ViewMetrics, float | None, float | None]:
        view = protocol.views[index]
        image = with_exposure(found.rgb, view)
        name = f"{index:04d}.png"
        Image.fromarray(image).save(out / name, compress_level=PNG_LEVEL)
        record = ViewMetrics(
            name=view.name, psnr=found.psnr(image), ssim=found.ssim(image), lpips=None, render=name
        )
        without_gains = found.psnr(to_bytes(found.rgb)) if gains else None
        own = None if found.own is None else found.psnr(to_bytes(found.own))
        return record, without_gains, own

    def collect(future: Future[tuple[ViewMetrics, float | None, float | None]]) -> None:
        record, psnr_without_gains, psnr_without_fit = future.result()
        per_view.append(record)
        if psnr_without_gains is not None:
            unadjusted.append(psnr_without_gains)
        if psnr_without_fit is not None:
            unfitted.append(psnr_without_fit)
        progress.advance(note=f"PSNR {record.psnr:.2f} dB")

    # Views are measured while the next ones are rendered. The queue is short: it holds the images.
    pending: deque[Future[tuple[ViewMetrics, float | None, float | None]]] = deque()
    distances: list[float] = []
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        for index, view in enumerate(protocol.views):
            found = render_and_load(view)
            if _hides_all(found.measured_mask):
                warnings.append(f"{view.name}: its mask leaves no pixel to measure")
                progress.advance()
                continue
            pending.append(pool.submit(measure, index, found))
            if lpips is not None:
                here, image = found.columns, with_exposure(found.rgb, view)
                distances.append(lpips(image[:, here], found.photo[:, here], found.measured_mask))
            if len(pending) > threads:
                collect(pending.popleft())
        while pending:
            collect(pending.popleft())
    if lpips is not None:
        per_view = [
            record.model_copy(update={"lpips": distance})
            for record, distance in zip(per_view, distances, strict=True)
        ]
    training: list[float] = []
    for view in protocol.training_views:
        found = render_and_load(view)
        if not _hides_all(found.measured_mask):
            training.append(found.psnr(with_exposure(found.rgb, view)))
        progress.advance()
    if not per_view:
        raise UserError("the masks leave no pixel of any view to measure", fix="check masks/")
    mean_psnr = float(np.mean([v.psnr for v in per_view]))
    train_psnr = float(np.mean(training)) if training else None
    if train_psnr is not None:
        warnings += diagnose(mean_psnr, train_psnr)
    return Evaluation(
        psnr=mean_psnr,
        train_psnr=train_psnr,
        psnr_without_gains=float(np.mean(unadjusted)) if gains else None,
        psnr_without_fit=float(np.mean(unfitted)) if unfitted else None,
        ssim=float(np.mean([v.ssim for v in per_view])),
        lpips=float(np.mean(distances)) if lpips is not None else None,
        lpips_reason=reason,
        per_view=tuple(per_view),
        protocol=ProtocolDescription(
            resolution=_sizes(protocol.views),
            split=_describe_split(protocol),
            poses_and_points=POSES_OF_SPLIT if protocol.listed else POSES_OF_ALL,
            num_views=len(per_view),
            num_photographs=_split_photographs(protocol.views),
            psnr="mean over the views of PSNR in dB, 8-bit renders, peak 1",
            ssim=SSIM_VARIANT,
            lpips=LPIPS_VARIANTS[config.lpips_net] if lpips is not None else reason,
            masks="masked pixels are excluded" if any(v.mask for v in protocol.views) else None,
            background=protocol.background,
            exposure=EXPOSURE_PROTOCOL if gains else None,
            appearance=APPEARANCE_PROTOCOL if unfitted else None,
            poses=POSES_PROTOCOL if train.refine_poses else None,
        ),
        model=EvaluatedModel(num_gaussians=len(gaussians), sh_degree=gaussians.sh_degree),
        warnings=tuple(warnings),
    )


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


def _hides_all(mask: Mask | None) -> bool:
    return mask is not None and not mask.any()


def _split_photographs(views: Sequence[View]) -> int | None:
    """Number of photographs that the views are parts of; None if each view is a photograph."""
    if all(view.source is None for view in views):
        return None
    return len({view.source or view.name for view in views})


def _sizes(views: Sequence[View]) -> tuple[str, ...]:
    sizes = sorted({(view.width, view.height) for view in views})
    return tuple(f"{w}x{h}" for w, h in sizes)


def _describe_split(protocol: Protocol) -> str:
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
