"""What Gaussians look like from the views: pictures and depth maps, drawn once and kept on disk."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from pipeline.photos.load import load_view
from pipeline.photos.naming import rename
from pipeline.render import RasterOptions
from pipeline.render.views import render_view, to_bytes
from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.progress import track
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

#: Pixels of less opacity have no depth.
MIN_ALPHA = 0.5


@dataclass(frozen=True)
class Picture:
    """A view as drawn.

    Attributes:
        view: the camera.
        rgb: (H, W, 3) uint8, over the background.
        median: (H, W) float32 camera z at pixel centres, world unit, of the Gaussian that takes
            the transmittance below one half; 0 where none does (opacity under ``MIN_ALPHA``).
        expected: (H, W) float32, likewise, the mean by weight; 0 in the same places.
    """

    view: View
    rgb: NDArray[np.uint8]
    median: NDArray[np.float32]
    expected: NDArray[np.float32]


class Pictures:
    """All views drawn, kept as files that are mapped when looked at: memory stays small."""

    def __init__(
        self, gaussians: Gaussians, views: Sequence[View], options: RasterOptions, folder: Path
    ):
        self.views, self._folder = list(views), folder
        folder.mkdir(parents=True, exist_ok=True)
        for i, view in enumerate(track(views, "drawing views", len(views), unit="views")):
            drawn = render_view(gaussians, view, options)
            known = drawn.alpha >= MIN_ALPHA
            depths = [
                np.where(known, drawn.median_depth, 0),
                np.where(known, drawn.depth / np.maximum(drawn.alpha, MIN_ALPHA), 0),
            ]
            np.save(folder / f"{i}.depth.npy", np.stack(depths).astype(np.float32))
            np.save(folder / f"{i}.rgb.npy", to_bytes(drawn.rgb))

    def __iter__(self) -> Iterator[Picture]:
        for i, view in enumerate(self.views):
            median, expected = np.load(self._folder / f"{i}.depth.npy", mmap_mode="r")
            yield Picture(view, np.load(self._folder / f"{i}.rgb.npy"), median, expected)


@dataclass(frozen=True)
class DepthMap:
    """What a view says of the surface.

    Attributes:
        view: the camera.
        depth: (H, W) float32 camera z in the world's unit at pixel centres; 0 where nothing is
            known, inf where the ray meets nothing.
        rgb: (H, W, 3) uint8.
    """

    view: View
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8]

    def surface(self, far: float) -> NDArray[np.float32]:
        """The depths up to ``far``, 0 elsewhere."""
        return np.where(self.depth < far, self.depth, np.float32(0))


class DepthMaps:
    """The training views' median depths, as often as they are gone through. Nothing is known of
    masked pixels; where the photograph is transparent there is nothing."""

    def __init__(self, pictures: Pictures):
        self._pictures = pictures
        self._count = sum(not view.is_test for view in pictures.views)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[DepthMap]:
        for picture in self._pictures:
            view = picture.view
            if view.is_test:
                continue
            photo = load_view(view)
            depth = np.array(picture.median)
            if photo.alpha is not None:
                depth[photo.alpha == 0] = np.inf
            if photo.mask is not None:
                depth[~photo.mask] = 0
            yield DepthMap(view, depth, picture.rgb)


def write_renders(folder: Path, pictures: Pictures) -> None:
    """``<photograph's name>.png`` of every view, 8 bit."""
    names = rename({view.name: ".png" for view in pictures.views})
    for picture in pictures:
        buffer = io.BytesIO()
        Image.fromarray(picture.rgb).save(buffer, "PNG")
        write_bytes(folder / names[picture.view.name], buffer.getvalue())


def write_depths(folder: Path, pictures: Pictures) -> None:
    """``median/`` and ``expected/<photograph's name>.tiff`` of every view: one channel of 32-bit
    floats, camera z (not the ray's length) in the unit of the cameras, 0 where nothing is."""
    names = rename({view.name: ".tiff" for view in pictures.views})
    for picture in pictures:
        for kind in ("median", "expected"):
            buffer = io.BytesIO()
            # A description would be out of order for libtiff, which warns of it.
            tifffile.imwrite(
                buffer, np.asarray(getattr(picture, kind)), compression="zlib", metadata=None
            )
            write_bytes(folder / kind / names[picture.view.name], buffer.getvalue())
