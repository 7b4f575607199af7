"""Which Gaussians of a finished scene are exported: those of a region, merged where views show
least of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.config.section import Box
from pipeline.render import RasterOptions
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import track
from pipeline.runtime.text import counted
from pipeline.scene.views import View, evenly_spaced
from pipeline.splats.arrays import GaussianArrays, GaussianRows, collect, joined
from pipeline.splats.levels import merged_to

Rows = NDArray[np.intp]
Region = Literal["subject"] | Box | None

#: The subject is what this share of the cameras have before them inside their images.
SUBJECT_SHARE = 0.6
#: The box of the subject leaves out this share of its Gaussians on each side of each axis.
OUTSIDE = 0.005
#: Fewer Gaussians than this share of the scene are no subject.
MIN_SUBJECT = 0.01
#: Numbers of views and of Gaussians, evenly spaced, from which the subject is estimated.
SUBJECT_VIEWS, SUBJECT_GAUSSIANS = 200, 200_000
#: A pixel shows the region if the region's Gaussians have over this share of it.
REGION_SHARE = 0.9
#: Number of views, evenly spaced, on which the cost is measured.
COST_VIEWS = 20


@dataclass(frozen=True)
class Selection:
    """The Gaussians to export.

    Attributes:
        gaussians: The Gaussians; invented ones are the last.
        num_invented: The number of invented ones.
        psnr: The mean PSNR of renders against those of all Gaussians, dB, over the pixels that the
            region shows; None where nothing was left out, or no view shows the region.
        decisions: What was chosen and what it costs, sentences.
    """

    gaussians: GaussianArrays
    num_invented: int = 0
    psnr: float | None = None
    decisions: list[str] = field(default_factory=list)


def select_gaussians(
    gaussians: GaussianArrays,
    max_gaussians: int | None,
    region: Region,
    views: Sequence[View],
    options: RasterOptions,
    num_invented: int = 0,
) -> Selection:
    """Choose Gaussians by region, then merge them to a number.

    Args:
        gaussians: All Gaussians of the scene; invented ones are the last.
        max_gaussians: The largest number of Gaussians; None for no limit. Invented ones, which no
            view shows, count and stay.
        region: A box (x0, y0, z0, x1, y1, z1) in the frame of the Gaussians, "subject" for a box
            around what the cameras look at, or None for everything.
        views: All views; test views only measure the cost. Empty for a box without a limit whose
            cost is not measured.
        options: How views are rendered. The number of threads does not affect results.

    Raises:
        UserError: Nothing is left, the cameras have no common subject, or invented Gaussians alone
            exceed ``max_gaussians``.
    """
    rows: Rows = np.arange(len(gaussians))
    decisions = []
    if region is not None:
        box = subject_box(gaussians, views) if region == "subject" else region
        rows = np.flatnonzero(in_box(gaussians.means, box))
        if not len(rows):
            raise _empty(box, gaussians.means)
        sides = " to ".join(", ".join(f"{value:.4g}" for value in box[i : i + 3]) for i in (0, 3))
        name = "the subject" if region == "subject" else "the region"
        decisions.append(f"{name}, {sides}, has {counted(len(rows), 'Gaussian')}")
    invented = int((rows >= len(gaussians) - num_invented).sum())
    chosen = _chosen(gaussians, rows)
    if max_gaussians is not None and len(rows) > max_gaussians:
        if invented >= max_gaussians:
            raise UserError(
                f"export.max_gaussians: expected more than the {invented} invented Gaussians, "
                f"found {max_gaussians}",
                fix="raise export.max_gaussians, or set holes.fill: none",
            )
        count = len(rows) - invented
        trained, sentence = _reduced(
            _chosen(chosen, np.arange(count)), max_gaussians - invented, views, options
        )
        decisions.append(sentence)
        chosen = joined([trained, _chosen(chosen, np.arange(count, len(rows)))])
    if len(chosen) == len(gaussians) or not views:
        return Selection(chosen, invented, decisions=decisions)
    shown = None if region is None else rows
    cost = psnr_against_all(gaussians, chosen, views, options, shown)
    if cost is not None:
        where = "where they show the region" if region is not None else "of the whole scene"
        decisions.append(f"PSNR {cost:.2f} dB against renders {where}")
    return Selection(chosen, invented, cost, decisions)


def _reduced(
    gaussians: GaussianArrays, count: int, views: Sequence[View], options: RasterOptions
) -> tuple[GaussianArrays, str]:
    """``count`` Gaussians that look like all of them from the training views, and a sentence:
    without those that no view shows, merged in pairs where the views show least, then refined."""
    # The module is imported here because it imports torch.
    from pipeline.export.refine import STEPS, refined

    weights = contributions_to(gaussians, views, options)
    kept = np.sort(np.argsort(-weights, kind="stable")[: max(count, (weights > 0).sum())])
    made = merged_to(_chosen(gaussians, kept), count, weights[kept])
    unseen, merged = len(gaussians) - len(kept), len(kept) - len(made)
    if merged:
        made = refined(made, gaussians, _training(views), options)
    parts = [f"{unseen:,} that no training view shows left out"] * (unseen > 0)
    parts += [f"{merged:,} merged into neighbours"] * (merged > 0)
    parts += [f"refined in {STEPS} steps"] * (merged > 0)
    return made, f"{counted(len(made), 'Gaussian')} of {len(gaussians):,}: {', '.join(parts)}"


def in_box(means: NDArray[np.float32], box: Box) -> NDArray[np.bool_]:
    """(N,) whether the means (N, 3) lie in a box, bounds included. Skyboxes lie far outside."""
    corners = np.asarray(box, np.float64).reshape(2, 3)
    return np.asarray(((means >= corners[0]) & (means <= corners[1])).all(1))


def subject_box(gaussians: GaussianArrays, views: Sequence[View]) -> Box:
    """A box around the Gaussians that most cameras have inside their images, whatever hides them.

    Raises:
        UserError: There are none: the cameras look in different directions.
    """
    step = max(1, len(gaussians) // SUBJECT_GAUSSIANS)
    means = gaussians.means[::step].astype(np.float64)
    seen = np.zeros(len(means))
    training = [view for view in views if not view.is_test]
    chosen = evenly_spaced(training or list(views), SUBJECT_VIEWS)
    for view in chosen:
        x, y, z = view.world_to_camera[:3, :3] @ means.T + view.world_to_camera[:3, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        seen += (z > 0) & (u > 0) & (u < view.width) & (v > 0) & (v < view.height)
    subject = means[seen >= SUBJECT_SHARE * len(chosen)]
    if len(subject) < max(MIN_SUBJECT * len(means), 1):
        raise UserError(
            "region: expected cameras that look at a common subject, found none that most of them "
            "have in their images",
            fix="give the region as a box, [x0, y0, z0, x1, y1, z1]",
        )
    low, high = np.quantile(subject, [OUTSIDE, 1 - OUTSIDE], axis=0)
    x0, y0, z0, x1, y1, z1 = map(float, (*low, *high))
    return x0, y0, z0, x1, y1, z1


def contributions_to(
    gaussians: GaussianArrays, views: Sequence[View], options: RasterOptions
) -> NDArray[np.float64]:
    """(N,) the sum of alpha times transmittance over all pixels of the training views, or of all
    views without any (the significance of LightGaussian, Fan et al. 2024, without its factor)."""
    from pipeline.render import make_backend
    from pipeline.render.contributions import contributions, in_grey
    from pipeline.render.views import raster_camera
    from pipeline.splats.gaussians import Gaussians

    grey, backend = in_grey(Gaussians.sharing(gaussians)), make_backend()
    options = replace(options, sh_degree=0, background=None)
    total = np.zeros(len(gaussians))
    training = _training(views)
    for view in track(training, "contributions", len(training), unit="views"):
        total += contributions(grey, raster_camera(view), options, 1.0, backend).numpy()
    return total


def psnr_against_all(
    gaussians: GaussianArrays,
    chosen: GaussianArrays,
    views: Sequence[View],
    options: RasterOptions,
    region: Rows | None = None,
) -> float | None:
    """Mean PSNR of renders of other Gaussians against those of all, in dB, over test views, or over
    all views without any.

    Args:
        region: The rows of ``gaussians`` in the region: only pixels count that show it, by
            ``REGION_SHARE``. None: all pixels count.
    """
    from pipeline.metrics.image import psnr
    from pipeline.render.views import render_rgb, to_bytes
    from pipeline.splats.gaussians import Gaussians
    from pipeline.splats.init import SH_C0

    everything, some = Gaussians.sharing(gaussians), Gaussians.sharing(chosen)
    marked = np.full((len(gaussians), 1, 3), -0.5 / SH_C0, np.float32)  # black
    marked[slice(0) if region is None else region] *= -1  # white
    shares = Gaussians.sharing(replace(gaussians, sh=marked))
    found = []
    for view in evenly_spaced([view for view in views if view.is_test] or list(views), COST_VIEWS):
        mask = None
        if region is not None:
            mask = (
                render_rgb(shares, view, replace(options, background=None))[:, :, 0] > REGION_SHARE
            )
            if not mask.any():
                continue
        left, whole = (to_bytes(render_rgb(s, view, options)) for s in (some, everything))
        found.append(psnr(left, whole, mask))
    return float(np.mean(found)) if found else None


def _training(views: Sequence[View]) -> list[View]:
    """The training views, or all views without any."""
    return [view for view in views if not view.is_test] or list(views)


def _chosen(gaussians: GaussianArrays, rows: Rows) -> GaussianArrays:
    """Copies of some Gaussians; all of them without a copy."""
    if len(rows) == len(gaussians):
        return gaussians
    return collect(GaussianRows(gaussians, rows, gaussians.sh_degree))


def _empty(box: Box, means: NDArray[np.float32]) -> UserError:
    """The error for a box without Gaussians."""
    low, high = (np.quantile(means, q, axis=0) for q in (0.05, 0.95))
    spans = ", ".join(
        f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True)
    )
    return UserError(
        f"region: expected a box with Gaussians, found none in {[float(f'{v:.6g}') for v in box]}; "
        f"most Gaussians are at {spans}",
        fix="give corners in the frame and unit of the exported files (frame.json)",
    )
