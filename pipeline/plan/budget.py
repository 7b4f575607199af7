"""The number of Gaussians and the memory of training, as settled by the plan."""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

from pipeline.config.schema import Config
from pipeline.geometry.cube import ROTATIONS, panorama_face_side
from pipeline.plan.scan import Scan
from pipeline.plan.training_memory import gaussians_in, in_blocks_mb, memory_mb
from pipeline.runtime.errors import UserError
from pipeline.scene.views import view_size

# The side of the windows of SSIM in pixels.
SSIM_WINDOW = 11
# The pixels of a view per Gaussian, for training by steps and with a time budget. Fewer pixels
# improve quality but cost time; a time budget limits the time by itself.
PIXELS_PER_GAUSSIAN, PIXELS_PER_GAUSSIAN_WITH_TIME_BUDGET = 2.0, 0.5
# The lower bound on the budget, and the training pixels of all photographs per Gaussian: fewer
# overfit.
MIN_GAUSSIANS = 20_000
TRAINING_PIXELS_PER_GAUSSIAN = 40
# More Gaussians do not converge within a time budget. Training lowers the number further on slow
# machines (``training.loop.step_time_estimator``).
GAUSSIANS_PER_MINUTE = 50_000


def gaussian_budget(scan: Scan, config: Config) -> tuple[int, str]:
    """The maximum number of Gaussians, and the sentence that gives the reason.

    The number is the smallest of the bounds by the size of a view, by the training pixels, by
    ``train.budget_minutes``, by ``density.max_gaussians`` and, for one block,
    ``partition.memory_mb``.

    Raises:
        UserError: ``partition.memory_mb`` is too small.
    """
    density = config.train.density
    typical = _typical(scan, config)
    area = typical.width * typical.height
    minutes, pixels = config.train.budget_minutes, density.pixels_per_gaussian
    if pixels == "auto":
        pixels = PIXELS_PER_GAUSSIAN if minutes is None else PIXELS_PER_GAUSSIAN_WITH_TIME_BUDGET
    # The views of a panorama show different parts of the scene.
    by_view = area * typical.views / pixels
    by_scene = area * _num_views(scan, config) / TRAINING_PIXELS_PER_GAUSSIAN
    by_time = math.inf if minutes is None else GAUSSIANS_PER_MINUTE * minutes
    wanted = max(MIN_GAUSSIANS, round(min(by_view, by_scene, by_time)))
    if density.strategy == "original" and density.pixels_per_gaussian == "auto":
        wanted = density.max_gaussians
    limited = _by_memory(config, min(wanted, density.max_gaussians))
    if limited is not None:
        return limited
    if wanted >= density.max_gaussians:
        return density.max_gaussians, f"at most {density.max_gaussians} Gaussians, as configured"
    why = f"one per {pixels:g} pixels of {'a panorama' if typical.views > 1 else 'a view'}"
    if by_scene < by_view:
        why = f"one per {TRAINING_PIXELS_PER_GAUSSIAN} pixels of all photographs"
    if by_time < min(by_view, by_scene):
        why = f"{GAUSSIANS_PER_MINUTE} per minute of {minutes:g} minutes"
    if wanted == MIN_GAUSSIANS:
        why = "the minimum"
    return wanted, f"at most {wanted} Gaussians: {why}"


def _by_memory(config: Config, wanted: int) -> tuple[int, str] | None:
    """The number of Gaussians that fit into ``partition.memory_mb`` as one block, and the reason;
    None if ``wanted`` fit, or may be divided. Photographs are not counted, since those that do not
    fit are read from disk."""
    limit = config.partition.memory_mb
    if limit is None or config.partition.blocks != 1 or memory_mb(0, wanted) <= limit:
        return None
    budget = gaussians_in(limit, 0)
    if budget < min(MIN_GAUSSIANS, wanted):
        least = memory_mb(0, min(MIN_GAUSSIANS, wanted))
        raise UserError(
            f"partition.memory_mb: {limit} MB are not enough for training; {least} are needed",
            fix="increase or remove it",
        )
    return budget, f"at most {budget} Gaussians: as many as fit into {limit} MB of memory"


def training_memory_mb(scan: Scan, config: Config) -> int:
    """The estimated peak memory of training in MB, at most ``partition.memory_mb``: photographs
    that do not fit are read from disk."""
    needed = memory_mb(_pixels(scan, config), config.train.density.max_gaussians)
    return min(needed, config.partition.memory_mb or needed)


def _pixels(scan: Scan, config: Config) -> int:
    return sum(p.width * p.height * p.views for p in _planned(scan, config))


def _num_views(scan: Scan, config: Config) -> int:
    return sum(photo.views for photo in _planned(scan, config))


class _Planned(NamedTuple):
    """The views of a photograph: their size in pixels and their number."""

    width: int
    height: int
    views: int


def _planned(scan: Scan, config: Config) -> list[_Planned]:
    """The views of each photograph, as far as they are known before the cameras are: six views of a
    panorama, one of each other photograph."""
    cap, given = config.views.max_long_side_px, scan.poses
    everywhere = (
        config.sfm.camera_model == "EQUIRECTANGULAR"
        if given is None
        else (given.models == ("EQUIRECTANGULAR",))
    )
    found = []
    for photo in scan.planned:
        if everywhere or (photo.panorama and given is None):
            side = min(panorama_face_side(photo.width), cap)
            found.append(_Planned(side, side, len(ROTATIONS)))
        else:
            found.append(_Planned(*view_size(photo.width, photo.height, cap), 1))
    return found


def _typical(scan: Scan, config: Config) -> _Planned:
    """The views of those photographs whose size has the most views."""
    planned = _planned(scan, config)
    if all(photo.views == 1 for photo in planned):
        return _Planned(*view_size(*scan.sizes[0], config.views.max_long_side_px), 1)
    views: Counter[_Planned] = Counter()
    for photo in planned:
        views[photo] += photo.views
    return views.most_common(1)[0][0]


def typical_view(scan: Scan, config: Config) -> tuple[int, int]:
    """The width and height of most views."""
    typical = _typical(scan, config)
    return typical.width, typical.height


def resolution_line(scan: Scan, config: Config) -> str:
    """The plan's sentence about the size of the views."""
    views = _num_views(scan, config)
    if views > len(scan.planned):
        width, height = typical_view(scan, config)
        return (
            f"{views} views, most of {width}x{height} pixels: panoramas are split into "
            f"{len(ROTATIONS)} views each"
        )
    (width, height), *others = scan.sizes
    cap = config.views.max_long_side_px
    small_width, small_height = view_size(width, height, cap)
    share = small_width / width
    text = f"views of {small_width}x{small_height} pixels, {share:.3g} times the photographs' size"
    if (small_width, small_height) == (width, height):
        text = f"views of {width}x{height} pixels, the photographs' size"
    if others:
        text += f" (the most frequent of {len(others) + 1} sizes; all at most {cap} px)"
    return text


def small_views_line(scan: Scan, config: Config) -> str:
    """The plan's sentence about views that are smaller than SSIM's window; empty if there are none.

    Raises:
        UserError: All views are smaller than the window.
    """
    planned = _planned(scan, config)
    small = [i for i, view in enumerate(planned) if min(view.width, view.height) < SSIM_WINDOW]
    if not small:
        return ""
    first = planned[small[0]]
    size = f"{first.width}x{first.height} pixels"
    if len(small) == len(planned):
        raise UserError(
            f"views of {size} are too small for training: expected at least {SSIM_WINDOW} pixels "
            "on the shorter side, the size of the windows in which images are compared",
            fix="raise views.max_long_side_px, or give larger photographs",
        )
    return (
        f"{len(small)} of {len(planned)} views have a shorter side of less than {SSIM_WINDOW} "
        f"pixels and contribute little (first: {scan.planned[small[0]].name}, {size})"
    )


def length_line(config: Config) -> str:
    """The plan's sentence about the length of training."""
    minutes = config.train.budget_minutes
    return f"{config.train.steps} steps" if minutes is None else f"{minutes:g} minutes"


def memory_line(scan: Scan, config: Config) -> str:
    """The plan's sentence about the memory of training."""
    limit, blocks = config.partition.memory_mb, config.partition.blocks
    if blocks not in ("auto", 1):
        width, height = typical_view(scan, config)
        gaussians = config.train.density.max_gaussians
        largest = in_blocks_mb(width * height, gaussians, int(blocks))
        return f"about {largest / 1000:.1f} GB of memory in the largest job"
    needed = memory_mb(_pixels(scan, config), config.train.density.max_gaussians)
    if limit is None or needed <= limit:
        return f"about {needed / 1000:.1f} GB of memory"
    return f"{limit / 1000:.1f} GB of memory, as configured: photographs are read from disk"
