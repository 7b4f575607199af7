"""Renders and depth maps of the views, computed once and cached on disk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.io.depth_tiff import write_depth_tiff
from pipeline.mvs.maps import DenseMap, read_map
from pipeline.photos.backdrop import SkyMasks
from pipeline.photos.load import load_view
from pipeline.photos.naming import rename
from pipeline.render import RasterOptions
from pipeline.render.views import render_view, to_bytes, write_png
from pipeline.runtime.progress import track
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

#: Least accumulated opacity of a pixel with a depth.
MIN_ALPHA = 0.5
#: Least confidence of a depth of multi-view stereo that is preferred to the rendered one.
MIN_CONFIDENCE = 0.25
#: Where photographs match in more than this share of what looks like sky, it is a smooth wall.
MAX_MATCHED = 0.1
#: The weight of a depth of multi-view stereo with a confidence of 1, beside rendered ones, which
#: weigh 1.
DENSE_WEIGHT = 6.0


@dataclass(frozen=True)
class RenderedView:
    """Render and depth of a view.

    Attributes:
        view: The camera.
        rgb: (H, W, 3) uint8, over the background.
        median: (H, W) float32 camera z, world units, of the Gaussian at which the transmittance
            falls below one half; 0 if the pixel's opacity is below ``MIN_ALPHA``.
        expected: (H, W) float32 mean camera z by blending weight; 0 for the same pixels.
    """

    view: View
    rgb: NDArray[np.uint8]
    median: NDArray[np.float32]
    expected: NDArray[np.float32]


class RenderCache:
    """Renders of all views, stored in a folder and memory-mapped, to bound memory."""

    def __init__(
        self, gaussians: Gaussians, views: Sequence[View], options: RasterOptions, folder: Path
    ):
        self.views, self._folder = list(views), folder
        folder.mkdir(parents=True, exist_ok=True)
        for i, view in enumerate(track(views, "rendering views", len(views), unit="views")):
            rendered = render_view(gaussians, view, options)
            has_depth = rendered.alpha >= MIN_ALPHA
            depths = [
                np.where(has_depth, rendered.median_depth, 0),
                np.where(has_depth, rendered.depth / np.maximum(rendered.alpha, MIN_ALPHA), 0),
            ]
            np.save(folder / f"{i}.depth.npy", np.stack(depths).astype(np.float32))
            np.save(folder / f"{i}.rgb.npy", to_bytes(rendered.rgb))

    def __iter__(self) -> Iterator[RenderedView]:
        for i, view in enumerate(self.views):
            median, expected = np.load(self._folder / f"{i}.depth.npy", mmap_mode="r")
            yield RenderedView(view, np.load(self._folder / f"{i}.rgb.npy"), median, expected)


@dataclass(frozen=True)
class DepthMap:
    """Depth observed by a view.

    Attributes:
        view: The camera.
        depth: (H, W) float32 camera z at pixel centres, world units; 0 if unknown, inf if the ray
            meets no surface.
        rgb: (H, W, 3) uint8.
        weight: (H, W) float32 how much a depth counts: 1 for a rendered one; None for 1 everywhere.
    """

    view: View
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    weight: NDArray[np.float32] | None = None

    def surface(self, far: float) -> NDArray[np.float32]:
        """The depths below ``far``; 0 elsewhere."""
        return np.where(self.depth < far, self.depth, np.float32(0))


class DepthMaps:
    """Depth maps of the training views; can be iterated repeatedly.

    A depth is that of multi-view stereo where it is confident, else the rendered median. Masked
    pixels are unknown (0); transparent pixels of a photograph and sky are empty (inf).

    Args:
        dense: The folder of the dense stage; None for rendered depths alone.
        unit: The length of the dense stage's unit of length in the renders' unit.
        sky: None: no pixel is sky.
    """

    def __init__(
        self,
        renders: RenderCache,
        dense: Path | None = None,
        unit: float = 1.0,
        sky: SkyMasks | None = None,
    ):
        self._renders, self._dense, self._unit, self._sky = renders, dense, unit, sky
        self._count = sum(not view.is_test for view in renders.views)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[DepthMap]:
        for rendered in self._renders:
            view = rendered.view
            if view.is_test:
                continue
            photo = load_view(view)
            depth, weight = np.array(rendered.median), None
            sky = np.zeros(depth.shape, bool) if self._sky is None else self._sky.of(view)
            if self._dense is not None:
                dense = read_map(self._dense, view.name)
                matched = dense.confidence >= MIN_CONFIDENCE
                if sky.any() and matched[sky].mean() > MAX_MATCHED:
                    sky[:] = False
                depth, weight = self._combined(depth, dense, matched)
                sky &= ~matched
            depth[sky] = np.inf
            if photo.alpha is not None:
                depth[photo.alpha == 0] = np.inf
            if photo.mask is not None:
                depth[~photo.mask] = 0
            yield DepthMap(view, depth, rendered.rgb, weight)

    def _combined(
        self, rendered: NDArray[np.float32], dense: DenseMap, matched: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The depths and their weights."""
        depth = np.where(matched, dense.depth * np.float32(self._unit), rendered)
        return depth, np.where(matched, np.float32(DENSE_WEIGHT) * dense.confidence, np.float32(1))


def write_renders(folder: Path, renders: RenderCache) -> None:
    """Write an 8-bit PNG of each view, named as its photograph."""
    names = rename({view.name: ".png" for view in renders.views})
    for rendered in renders:
        write_png(folder / names[rendered.view.name], rendered.rgb)


def write_depths(folder: Path, renders: RenderCache) -> None:
    """Write a TIFF of each view, named as its photograph, into ``median/`` and ``expected/``.

    One channel of 32-bit floats: camera z (not distance along the ray), world units; 0 if there is
    no surface.
    """
    names = rename({view.name: ".tiff" for view in renders.views})
    for rendered in renders:
        for kind in ("median", "expected"):
            path = folder / kind / names[rendered.view.name]
            write_depth_tiff(path, getattr(rendered, kind))
