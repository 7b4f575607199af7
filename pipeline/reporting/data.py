"""The results of a scene that its page shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.coverage.record import CoverageRecord
from pipeline.holes.record import HolesRecord
from pipeline.metrics.evaluation import ViewMetrics
from pipeline.plan.record import PlanRecord
from pipeline.reporting.metrics import TimedMetrics
from pipeline.reporting.publish import Download
from pipeline.scene.blocks import Partition
from pipeline.scene.normalization import IDENTITY, Normalization
from pipeline.scene.reconstruction import Points
from pipeline.scene.views import View
from pipeline.splats.arrays import GaussianArrays
from pipeline.training.loop.curve import CurveRecord

Rank = Literal["worst", "low", "median", "high", "best"]


@dataclass(frozen=True)
class Comparison:
    """A test view with its photograph, both on the stored pixel grid.

    Attributes:
        label: The rank of the view by PSNR.
        name: The photograph's name.
        photograph, render: The images, (H, W, 3) uint8.
        mask: The mask, (H, W), whose zero pixels are excluded; or None.
        psnr, ssim: The measures of this view.
        orientation: The EXIF orientation, 1 to 8; it rotates the images for display only.
    """

    label: Rank
    name: str
    photograph: NDArray[np.uint8]
    render: NDArray[np.uint8]
    mask: NDArray[Any] | None
    psnr: float
    ssim: float
    orientation: int = 1


@dataclass(frozen=True)
class TrainedScene:
    """The trained scene with what is needed to display it.

    Attributes:
        gaussians: The Gaussians in the world frame of the views.
        views: The training and test views.
        orientations: The EXIF orientation of each view's photograph; 1 if there is none.
        background: The RGB colour in [0, 1] behind the Gaussians.
        antialias, near: The options of the training.
        normalization: The similarity from the world of the given poses, which positions of
            proposed viewpoints refer to, to that of the views.
        is_metric: Whether the unit of the given world is the metre.
        up: (3,) the unit vector upwards in the world; None if only the cameras tell it.
    """

    gaussians: GaussianArrays
    views: Sequence[View]
    orientations: Mapping[str, int]
    background: tuple[float, float, float]
    antialias: bool
    near: float
    normalization: Normalization = IDENTITY
    is_metric: bool = False
    up: NDArray[np.float64] | None = None


class BlockRun(NamedTuple):
    """The training of one block, both rounds together.

    Attributes:
        gaussians: The number of trained Gaussians, including the margin.
        psnr: The PSNR of its training views at the end, dB, over their windows.
        wall_s, peak_rss_mb: The time and the largest memory.
    """

    gaussians: int
    psnr: float
    wall_s: float
    peak_rss_mb: float


@dataclass(frozen=True)
class BlocksSection:
    """The blocks of a scene and their trainings, by number."""

    partition: Partition
    runs: Sequence[BlockRun]


@dataclass(frozen=True)
class CoverageSection:
    """Coverage of the scene by its photographs.

    Attributes:
        record: The measures.
        pictures: The images by the names in ``record``: (H, W, 3) renders and maps of
            contradictions, and (H, W) trust maps, uint8.
    """

    record: CoverageRecord
    pictures: Mapping[str, NDArray[np.uint8]]


@dataclass(frozen=True)
class HolesSection:
    """What was invented where no photograph sees the scene.

    Attributes:
        record: The measures.
        pictures: The render before, the mask and the render after of some painted views, uint8.
    """

    record: HolesRecord
    pictures: Sequence[Sequence[NDArray[np.uint8]]]


class TrainingRecord(NamedTuple):
    """A record of the training curve, and the seconds of training at its end."""

    values: CurveRecord
    seconds: float


@dataclass(frozen=True)
class SceneResults:
    """The results of one scene, read once from the outputs of its stages.

    Attributes:
        metrics: The content of ``metrics.json`` with the times of the stages.
        plan: The plan of the scene.
        trained: The Gaussians and their views.
        points: The sparse points, world.
        coverage: The coverage by the photographs.
        decisions: The decisions of each stage, the plan's and those of ``stage.json``.
        curve: The training curve.
        comparisons: The views to show, worst first.
        blocks: The trained blocks; None for a scene that was trained as one block.
        holes: What was invented; None without.
        photographs: The photograph's name for each view that has another name.
        downloads: The exported files.
        judgement: Whether the result meets the rules of acceptance, in a line; None without rules.
    """

    metrics: TimedMetrics
    plan: PlanRecord
    trained: TrainedScene
    points: Points
    coverage: CoverageSection
    decisions: Mapping[str, Sequence[str]]
    curve: Sequence[TrainingRecord]
    comparisons: Sequence[Comparison]
    blocks: BlocksSection | None = None
    holes: HolesSection | None = None
    photographs: Mapping[str, str] = field(default_factory=dict)
    downloads: Sequence[Download] = ()
    judgement: str | None = None


def ranked(per_view: Sequence[ViewMetrics], count: int) -> list[tuple[Rank, ViewMetrics]]:
    """``count`` views from the worst PSNR to the best, evenly spaced by rank, each with its label;
    fewer if there are fewer views."""
    ordered = sorted(per_view, key=lambda view: (view.psnr, view.name))
    count = min(count, len(ordered))
    if count == 1:
        return [("median", ordered[len(ordered) // 2])]
    chosen: list[tuple[Rank, ViewMetrics]] = []
    for i in range(count):
        share = i / (count - 1)
        label: Rank = "median" if share == 0.5 else "low" if share < 0.5 else "high"
        if share in (0, 1):
            label = "best" if share else "worst"
        chosen.append((label, ordered[round(share * (len(ordered) - 1))]))
    return chosen
