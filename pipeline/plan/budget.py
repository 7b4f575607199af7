"""How many Gaussians a scene gets, and what memory training them takes: settled by the plan."""

from __future__ import annotations

import math

from pipeline.config.schema import Config
from pipeline.plan.scan import Scan
from pipeline.plan.training_memory import gaussians_in, memory_mb
from pipeline.runtime.errors import UserError
from pipeline.scene.views import view_size

# Of a view. Twice as many give bonsai 0.5 dB in the steps of the default, at 1.3 times the time,
# and twice as many again 0.3 dB in 9000 steps: for those who say how long they will wait.
PIXELS_PER_GAUSSIAN, PIXELS_PER_GAUSSIAN_BY_CLOCK = 2.0, 0.5
# Fewer Gaussians than this make no picture; and each wants to be seen in so many pixels of all
# photographs together, or it learns single pictures by heart.
MIN_GAUSSIANS = 20_000
PIXELS_SEEN_PER_GAUSSIAN = 40
# And each wants its share of a run by the clock: fox in one minute on two cores, 28.9 dB with
# 205 000, 30.9 dB with 50 000; on faster ones, views kept back, 33.1 with 100 000 and 33.9 with
# 50 000. Where that are too many for the machine at hand, training sees it
# (``training.loop.step_time_estimator``).
GAUSSIANS_A_MINUTE = 50_000


def gaussian_budget(scan: Scan, config: Config) -> tuple[int, str]:
    """How many Gaussians the scene gets: as many as its pictures can tell apart and its minutes
    can train."""
    density = config.train.density
    width, height = view_size(*scan.sizes[0], config.views.max_long_side_px)
    minutes, pixels = config.train.budget_minutes, density.pixels_per_gaussian
    if pixels == "auto":
        pixels = PIXELS_PER_GAUSSIAN if minutes is None else PIXELS_PER_GAUSSIAN_BY_CLOCK
    by_view = width * height / pixels
    by_scene = width * height * len(scan.photos) / PIXELS_SEEN_PER_GAUSSIAN
    by_clock = math.inf if minutes is None else GAUSSIANS_A_MINUTE * minutes
    wanted = max(MIN_GAUSSIANS, round(min(by_view, by_scene, by_clock)))
    if density.strategy == "original" and density.pixels_per_gaussian == "auto":
        wanted = density.max_gaussians
    limited = _by_memory(config, min(wanted, density.max_gaussians))
    if limited is not None:
        return limited
    if wanted >= density.max_gaussians:
        return density.max_gaussians, f"at most {density.max_gaussians} Gaussians, as configured"
    why = f"one for {pixels:g} px of a view"
    if by_scene < by_view:
        why = f"one for each {PIXELS_SEEN_PER_GAUSSIAN} pixels of these few photographs"
    if by_clock < min(by_view, by_scene):
        why = f"{GAUSSIANS_A_MINUTE} for each of {minutes:g} minutes"
    if wanted == MIN_GAUSSIANS:
        why = "the least"
    return wanted, f"at most {wanted} Gaussians: {why}"


def _by_memory(config: Config, wanted: int) -> tuple[int, str] | None:
    """What ``train.memory_mb`` leaves of the Gaussians wanted; None: all. Pictures that do not fit
    beside them are read from disk, so they take nothing here."""
    limit = config.train.memory_mb
    if limit is None or memory_mb(0, wanted) <= limit:
        return None
    budget = gaussians_in(limit, 0)
    if budget < min(MIN_GAUSSIANS, wanted):
        least = memory_mb(0, min(MIN_GAUSSIANS, wanted))
        raise UserError(
            f"train.memory_mb: {limit} MB are too few to train in; at least {least} are needed",
            fix="raise train.memory_mb, or leave it out",
        )
    return budget, f"at most {budget} Gaussians: what {limit} MB of memory hold"


def training_memory_mb(scan: Scan, config: Config) -> int:
    """What training takes at most, roughly: ``memory_mb`` of the scene's views and its budget, of
    which a given ``train.memory_mb`` has the pictures read from disk."""
    taken = memory_mb(_pixels(scan, config), config.train.density.max_gaussians)
    return min(taken, config.train.memory_mb or taken)


def _pixels(scan: Scan, config: Config) -> int:
    sizes = [view_size(p.width, p.height, config.views.max_long_side_px) for p in scan.photos]
    return sum(width * height for width, height in sizes)


def resolution_line(scan: Scan, config: Config) -> str:
    """What the plan says of the size of the views."""
    (width, height), *others = scan.sizes
    cap = config.views.max_long_side_px
    small_width, small_height = view_size(width, height, cap)
    share = small_width / width
    text = f"views of {small_width}x{small_height} pixels, {share:.3g} of the photographs"
    if (small_width, small_height) == (width, height):
        text = f"views of {width}x{height} pixels, as photographed"
    if others:
        text += f" (the commonest of {len(others) + 1} sizes; none above {cap} px)"
    return text


def length_line(config: Config) -> str:
    """What the plan says of the length of training."""
    minutes = config.train.budget_minutes
    return f"{config.train.steps} steps" if minutes is None else f"{minutes:g} minutes"


def memory_line(scan: Scan, config: Config) -> str:
    """What the plan says of ``training_memory_mb``."""
    limit = config.train.memory_mb
    taken = memory_mb(_pixels(scan, config), config.train.density.max_gaussians)
    if limit is None or taken <= limit:
        return f"about {taken / 1000:.1f} GB of memory"
    return f"{limit / 1000:.1f} GB of memory, as configured: pictures are read from disk"
