"""Training images: 8-bit pixels of the views at the resolution in use."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.photos.load import ViewPixels, load_view, resize_area
from pipeline.render import Surroundings
from pipeline.runtime.progress import track
from pipeline.scene.views import View
from pipeline.training.data.image_store import ImageStore, MemoryStore, Planes

# Shorter side, pixels, below which SSIM's windows of 11 pixels mostly cover borders.
MIN_SHORT_SIDE = 64


@dataclass(frozen=True)
class Target:
    """One view's pixels.

    Attributes:
        rgb: (H, W, 3) uint8, multiplied by alpha; 0 where a mask excludes it.
        alpha: (H, W) uint8, 255 where ignored, or None if the view is opaque.
        ignored: (H, W) bool, True for ignored pixels, or None if there are none.
        surroundings: The layers around a block, or None if the whole scene is trained.
        is_overview: Whether the view is an overview of a block: the block is in the ignored pixels,
            and trained in another view.
        transient: (H, W) bool, the ignored pixels in which something that passed by hides the scene
            (``training.transients``), or None if there are none. ``rgb`` has it.
    """

    rgb: Tensor
    alpha: Tensor | None
    ignored: Tensor | None
    surroundings: Surroundings | None = None
    is_overview: bool = False
    transient: Tensor | None = None

    def over(self, background: tuple[float, float, float]) -> Tensor:
        """The image over ``background`` (in [0, 1]): (H, W, 3), uint8 if the view is opaque, else
        float32 in [0, 1]."""
        if self.alpha is None:
            return self.rgb
        behind = (255 - self.alpha.to(torch.int16)).to(torch.float32)[..., None]
        return (self.rgb.to(torch.float32) + behind * torch.tensor(background)) / 255.0


def psnr_of(squared_error: float) -> float:
    """PSNR in dB of a mean squared error of values in [0, 1]."""
    return -10 * math.log10(max(squared_error, 1e-10))


@dataclass(frozen=True)
class Layers:
    """A view of a scene of which one block is trained.

    Attributes:
        surroundings: The layers around the block.
        weight: (H, W) float32, the part of the scene's error that the block is to correct; other
            blocks correct the rest.
        coarse: (H, W, 3) uint8, the scene before training with the view's exposure.
        background: The background behind the scene, and behind photographs with alpha.
        ignored: (H, W) bool, pixels that another view of the block shows; None if there are none.
    """

    surroundings: Surroundings
    weight: Tensor
    coarse: Tensor
    background: tuple[float, float, float]
    ignored: Tensor | None = None


LayerSource = Callable[[View], Layers]


class Targets:
    """The pixels of all views. Images of a reduced resolution are computed at their first use; only
    one reduced resolution is stored at a time.

    Args:
        store: The storage of the pixels. None: in memory.
        layers: The layers around a block in each view. None: the whole scene is trained.
    """

    def __init__(
        self,
        views: Sequence[View],
        threads: int,
        store: ImageStore | None = None,
        layers: LayerSource | None = None,
    ):
        self._store = MemoryStore() if store is None else store

        def load(view: View) -> _StoredTarget:
            target = _target(load_view(view))
            if layers is not None:
                target = _among(target, layers(view))
            return _StoredTarget(target, self._store)

        with ThreadPoolExecutor(max(1, threads)) as pool:
            self._full = list(
                track(pool.map(load, views), "reading views", len(views), unit="views")
            )
        self._factor = 1
        self._reduced: dict[int, _StoredTarget] = {}

    @property
    def have_alpha(self) -> bool:
        return any(stored.has_alpha for stored in self._full)

    def hidden(self) -> list[int]:
        """Indices of the views whose pixels are all ignored."""
        return [index for index, stored in enumerate(self._full) if stored.hidden]

    def reduced(self, index: int, factor: int) -> Target:
        """The same as ``get``, without storing the result."""
        full = self._full[index].get()
        return full if factor == 1 else _reduce(full, factor)

    def drop(self, indices: Sequence[int]) -> None:
        """Remove these views; the indices of later views decrease."""
        self._full = [t for index, t in enumerate(self._full) if index not in indices]

    def get(self, index: int, factor: int) -> Target:
        """View ``index`` at 1 / ``factor`` of its size (see ``reduced_size``)."""
        if factor == 1:
            self._reduced.clear()
            return self._full[index].get()
        if factor != self._factor:
            self._factor, self._reduced = factor, {}
        if index not in self._reduced:
            reduced = _reduce(self._full[index].get(), factor)
            self._reduced[index] = _StoredTarget(reduced, self._store)
        return self._reduced[index].get()


class _StoredTarget:
    """A target in an image store, with the facts that are needed without reading it."""

    def __init__(self, target: Target, store: ImageStore):
        self.has_alpha, self.is_overview = target.alpha is not None, target.is_overview
        self.hidden = target.ignored is not None and bool(target.ignored.all())
        planes: Planes = (target.rgb, target.alpha, target.ignored)
        if (around := target.surroundings) is not None:
            planes += (around.behind, around.alpha, around.front, around.transmittance)
            planes += (around.correction,)
        self._read: Callable[[], Planes] = store.add(planes)

    def get(self) -> Target:
        (rgb, alpha, ignored), layers = (planes := self._read())[:3], planes[3:]
        assert rgb is not None
        if not layers:
            return Target(rgb, alpha, ignored)
        behind, block_alpha, *others = layers
        assert behind is not None and block_alpha is not None
        around = Surroundings(behind, block_alpha, *others)
        return Target(rgb, alpha, ignored, around, self.is_overview)


def usable_factor(views: Sequence[View], factor: int) -> int:
    """``factor``, halved until every reduced view has ``MIN_SHORT_SIDE`` pixels, or until 1."""
    if factor == 1:  # Most steps: the views need not be searched.
        return 1
    shortest = min(min(view.width, view.height) for view in views)
    while factor > 1 and shortest / factor < MIN_SHORT_SIDE:
        factor //= 2
    return factor


def _target(pixels: ViewPixels) -> Target:
    rgb, alpha = pixels.rgb, pixels.alpha
    ignored = None if pixels.mask is None or pixels.mask.all() else ~pixels.mask
    if alpha is not None:
        rgb = np.rint(rgb * (alpha[..., None].astype(np.float32) / 255.0)).astype(np.uint8)
    if ignored is not None:
        # SSIM's windows include pixels across a mask's edge: all ignored pixels have one value.
        rgb = np.where(ignored[..., None], np.uint8(0), rgb)
        alpha = None if alpha is None else np.where(ignored, np.uint8(255), alpha)
    if alpha is not None and alpha.min() == 255:
        alpha = None
    return Target(_tensor(rgb), _tensor_or_none(alpha), _tensor_or_none(ignored))


def _among(target: Target, layers: Layers) -> Target:
    photograph = target.over(layers.background)
    if target.alpha is not None:
        photograph = photograph * 255
    rgb = torch.lerp(layers.coarse.float(), photograph.float(), layers.weight[..., None])
    rgb = rgb.round().to(torch.uint8)
    ignored, is_overview = target.ignored, layers.ignored is not None
    if layers.ignored is not None:
        ignored = layers.ignored if ignored is None else ignored | layers.ignored
    return Target(rgb, None, ignored, layers.surroundings, is_overview)


def _reduce(target: Target, factor: int) -> Target:
    """The mean over pixels that are not ignored; a reduced pixel is ignored if over half of its
    pixels are."""
    height, width = target.rgb.shape[:2]
    size = max(1, round(width / factor)), max(1, round(height / factor))
    rgb, alpha = target.rgb.numpy(), None if target.alpha is None else target.alpha.numpy()
    if target.ignored is None:
        small_alpha = None if alpha is None else resize_area(alpha, *size)
        return Target(_tensor(resize_area(rgb, *size)), _tensor_or_none(small_alpha), None)
    counts = (~target.ignored.numpy()).astype(np.float32)
    share = resize_area(counts, *size)
    ignored = share < 0.5

    def mean(values: NDArray[np.uint8], hidden: int) -> NDArray[np.uint8]:
        weight, total, behind = (
            plane[..., None] if values.ndim == 3 else plane for plane in (counts, share, ignored)
        )
        small = np.rint(resize_area(values * weight, *size) / np.maximum(total, 1e-6))
        return np.where(behind, hidden, small.clip(0, 255)).astype(np.uint8)

    small_alpha = None if alpha is None else mean(alpha, 255)
    return Target(_tensor(mean(rgb, 0)), _tensor_or_none(small_alpha), _tensor(ignored))


def _tensor(array: NDArray[Any]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))


def _tensor_or_none(array: NDArray[Any] | None) -> Tensor | None:
    return None if array is None else _tensor(array)
