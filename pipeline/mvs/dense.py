"""Multi-view stereo of a scene: depth maps of all training views and a fused point cloud.

Three passes over the views: planes by PatchMatch stereo, filtering by geometric consistency,
fusion. Each view is one thread's work, and random numbers depend on the view alone, so results do
not depend on the number of threads. Planes are stored in the scratch folder between the passes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.mvs.consistency import FilterOptions, PlaneMap, filtered
from pipeline.mvs.counters import DenseCounters
from pipeline.mvs.estimate import (
    StereoOptions,
    estimate_planes,
    load_picture,
    normals_of,
)
from pipeline.mvs.fusion import fused_points, joined, symmetric
from pipeline.mvs.maps import (
    DenseCloud,
    DenseMap,
    planes_of,
    read_map,
    write_dense_cloud,
    write_map,
)
from pipeline.mvs.patchmatch import Picture
from pipeline.mvs.sources import seen_points, select_sources
from pipeline.photos.load import load_view
from pipeline.photos.threads import for_each
from pipeline.runtime.atomic import written
from pipeline.runtime.counters import Report
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

# Views whose pixels or maps are in memory at a time, besides those of each thread.
CACHED_VIEWS = 12
# Below this share of pixels with a depth, there is a warning.
FEW_PIXELS = 0.2


@dataclass(frozen=True)
class DenseOptions:
    """Parameters of the dense stage.

    Attributes:
        num_sources: The number of source views of each view.
        num_neighbours: The least number of views that each view is compared with in fusion.
        max_points: The largest number of points of the fused cloud.
    """

    num_sources: int = 6
    num_neighbours: int = 8
    max_points: int = 5_000_000
    stereo: StereoOptions = field(default_factory=StereoOptions)
    filter: FilterOptions = field(default_factory=FilterOptions)


def reconstruct(
    views: Sequence[View],
    model: Reconstruction,
    out: Path,
    scratch: Path,
    threads: int,
    options: DenseOptions | None = None,
) -> Report[DenseCounters]:
    """Write the depth maps of the views and the fused cloud (``pipeline.mvs.maps``) into ``out``.

    Args:
        views: The training views, sorted by name.
        model: The model with their sparse points.
        scratch: A folder for planes, which a later run with the same inputs finds.

    Raises:
        UserError: a photograph cannot be read, or the kernel cannot be compiled.
    """
    scene = _Scene(views, model, out, scratch, options or DenseOptions())
    numbers = range(len(views))
    for_each(scene.estimate, numbers, threads, "multi-view stereo", "views")
    shares = for_each(scene.filter, numbers, threads, "filtering depth maps", "views")
    cloud = joined(for_each(scene.fuse, numbers, threads, "fusing depth maps", "views"))
    write_dense_cloud(out, cloud)
    return scene.report(np.array(shares), cloud)


class _Scene:
    """The work on each view, by its index."""

    def __init__(
        self,
        views: Sequence[View],
        model: Reconstruction,
        out: Path,
        scratch: Path,
        options: DenseOptions,
    ):
        self._views, self._xyz, self._options = views, model.points.xyz, options
        self._out, self._planes = out, scratch / "planes"
        self._planes.mkdir(parents=True, exist_ok=True)
        self._sources = select_sources(views, model, options.num_sources)
        self._neighbours = symmetric(select_sources(views, model, options.num_neighbours))
        self._seen = seen_points(views, model)
        self._picture: Callable[[int], Picture] = lru_cache(CACHED_VIEWS)(
            lambda index: load_picture(self._views[index])
        )
        self._filtered: Callable[[int], PlaneMap] = lru_cache(CACHED_VIEWS)(self._read_filtered)

    def estimate(self, index: int) -> None:
        """Planes and costs of a view, unless an earlier run has stored them."""
        if self._file(index).is_file():
            return
        reference = self._picture(index)
        sources = [self._picture(int(source)) for source in self._sources[index]]
        xyz = self._xyz[self._seen[index]]
        planes, costs = estimate_planes(reference, sources, xyz, index, self._options.stereo)
        with written(self._file(index)) as file:
            np.save(file, np.concatenate([planes, costs[None]]))

    def filter(self, index: int) -> tuple[int, int, float]:
        """Write the filtered map of a view; returns the number of valid pixels, of pixels with a
        depth, and the sum of their confidences."""
        view = self._views[index]
        planes, costs = self._stored(index)
        reference = PlaneMap(view, planes)
        others = (
            PlaneMap(self._views[other], self._stored(other)[0])
            for other in map(int, self._sources[index])
        )
        inverse, confidence = filtered(reference, costs, others, self._options.filter)
        known = inverse > 0
        depth = np.where(known, 1 / np.where(known, inverse, 1), 0)
        normals = np.where(known[..., None], normals_of(planes, view), 0)
        found = DenseMap(depth.astype(np.float32), np.asarray(normals, np.float32), confidence)
        write_map(self._out, view.name, found)
        valid = self._picture(index).valid
        return int(valid.sum()), int(known.sum()), float(confidence.sum())

    def fuse(self, index: int) -> DenseCloud:
        """The points of the cloud that a view contributes."""
        view = self._views[index]
        return fused_points(
            index,
            self._views,
            self._neighbours[index],
            read_map(self._out, view.name),
            load_view(view).rgb,
            self._filtered,
            self._options.filter,
            -(-self._options.max_points // len(self._views)),
        )

    def report(self, shares: NDArray[np.float64], cloud: DenseCloud) -> Report[DenseCounters]:
        """Args: shares: (V, 3) as ``filter`` returns."""
        valid, known, confidence = shares.sum(0).tolist() if len(shares) else (0, 0, 0.0)
        alone = sum(len(sources) == 0 for sources in self._sources)
        counters = DenseCounters(
            depth_maps=len(self._views) - alone,
            without_sources=alone,
            completeness=known / max(valid, 1),
            confidence=min(confidence / max(known, 1), 1.0),
            dense_points=len(cloud),
        )
        decisions = [
            f"depth maps of {counters.depth_maps} training views; "
            f"{100 * counters.completeness:.0f} % of the pixels have a depth",
            f"{len(cloud):,} points in the fused cloud",
        ]
        warnings = []
        if alone:
            warnings.append(
                f"{alone} of {len(self._views)} training views have no depth map: no other view "
                "has a similar direction and another position"
            )
        if counters.completeness < FEW_PIXELS:
            warnings.append(
                f"only {100 * counters.completeness:.0f} % of the pixels have a depth that other "
                "views confirm: surfaces without texture, moving objects, inaccurate poses or too "
                "little overlap (init.method: points does not use depth maps)"
            )
        return Report(counters, decisions, warnings)

    def _file(self, index: int) -> Path:
        return self._planes / f"{index}.npy"

    def _stored(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        arrays = np.load(self._file(index), mmap_mode="r")
        return arrays[:3], arrays[3]

    def _read_filtered(self, index: int) -> PlaneMap:
        view = self._views[index]
        found = read_map(self._out, view.name)
        return PlaneMap(view, planes_of(found.depth, found.normals, view))
