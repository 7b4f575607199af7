"""The map of a scene's blocks on its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.reporting.data import SceneResults
from pipeline.scene.blocks import Partition

_WIDTH, _MARGIN = 560, 14
_MAX_POINTS = 3000
# The map shows the points between these quantiles, along each axis.
_SHOWN = 0.02, 0.98


@dataclass(frozen=True)
class BlocksMap:
    """Blocks, sparse points and training cameras from above, in pixels.

    Attributes:
        points: The x, y and RGB of each point.
        cameras: The x and y of each camera.
        boxes: The kind ("region": with its margin), number, left, top, right and bottom of each.
    """

    width: int
    height: float
    points: Sequence[tuple[float, float, list[int]]]
    cameras: Sequence[tuple[float, float]]
    boxes: Sequence[tuple[str, int, float, float, float, float]]


def blocks_map(results: SceneResults, partition: Partition) -> BlocksMap:
    """The map of the blocks with their margins."""
    axes = np.array(partition.axes)[:2]
    step = max(1, len(results.points.xyz) // _MAX_POINTS)
    points, colors = _flat(axes, results.points.xyz[::step]), results.points.rgb[::step]
    centres = [view.centre for view in results.trained.views if not view.is_test]
    cameras = _flat(axes, np.array(centres).reshape(-1, 3))
    low, high = _extent(points, cameras)
    scale = (_WIDTH - 2 * _MARGIN) / (high[0] - low[0])
    height = (high[1] - low[1]) * scale + 2 * _MARGIN

    def place(x: float, y: float) -> tuple[float, float]:
        x, y = min(max(x, low[0]), high[0]), min(max(y, low[1]), high[1])
        return _MARGIN + (x - low[0]) * scale, height - _MARGIN - (y - low[1]) * scale

    boxes = []
    for number in range(1, len(partition.blocks) + 1):
        for kind, box in (("region", partition.region(number)), ("block", partition.box(number))):
            (left, bottom), (right, top) = place(*box.lower[:2]), place(*box.upper[:2])
            boxes.append((kind, number, left, top, right, bottom))
    return BlocksMap(
        width=_WIDTH,
        height=height,
        points=[(*place(*p), rgb) for p, rgb in zip(points, colors.tolist(), strict=True)],
        cameras=[place(*p) for p in cameras],
        boxes=boxes,
    )


def _flat(axes: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    # Use einsum, not a matrix product: BLAS may round differently with the number of threads.
    return np.einsum("ij,nj->ni", axes, points)


def _extent(
    points: NDArray[np.float64], cameras: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner of the map, never without an extent."""
    corners = [np.quantile(points, _SHOWN, axis=0)] if len(points) else []
    corners += [np.stack([cameras.min(0), cameras.max(0)])] if len(cameras) else []
    if not corners:
        return np.zeros(2), np.ones(2)
    low = np.min([c[0] for c in corners], 0)
    high = np.max([c[1] for c in corners], 0)
    border = max(1e-9, 0.04 * float((high - low).max()))
    return low - border, high + border
