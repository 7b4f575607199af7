"""What the renders are compared with: the views' pixels, as 8 bits, at the resolution in use."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.config.schema import Train
from pipeline.photos.load import ViewPixels, load_view, resize_area
from pipeline.runtime.progress import track
from pipeline.scene.views import View
from pipeline.training.data.image_store import MemoryShelf, Planes, Shelf

# Below this (pixels on the shorter side) SSIM's window of 11 sees little but borders.
MIN_SHORT_SIDE = 64


@dataclass(frozen=True)
class Target:
    """One view's pixels.

    Attributes:
        rgb: (H, W, 3) uint8, multiplied by alpha; 0 where ignored.
        alpha: (H, W) uint8, or None where the view is opaque; 255 where ignored.
        ignored: (H, W) bool, True where pixels count for nothing, or None where all count.
    """

    rgb: Tensor
    alpha: Tensor | None
    ignored: Tensor | None

    def over(self, background: tuple[float, float, float]) -> Tensor:
        """The picture in front of ``background`` (linear in [0, 1]): (H, W, 3), uint8 where the
        view is opaque, else float32 in [0, 1]."""
        if self.alpha is None:
            return self.rgb
        behind = (255 - self.alpha.to(torch.int16)).to(torch.float32)[..., None]
        return (self.rgb.to(torch.float32) + behind * torch.tensor(background)) / 255.0

    def alpha_gradient(self, alpha: Tensor, config: Train) -> Tensor | None:
        """(H, W) float32 dL/d(alpha) of what is asked of the rendered ``alpha`` (H, W) itself: to
        vanish where a mask hides the photograph, and elsewhere to be the photograph's."""
        hidden = self.thinning(config.masked_opacity)
        shown = self.covering(alpha, config.alpha_weight, config.square_weight)
        if hidden is None or shown is None:
            return shown if hidden is None else hidden
        return hidden + shown

    def thinning(self, weight: float) -> Tensor | None:
        """(H, W) float32 dL/d(alpha) by which what is drawn on ignored pixels grows thin, None
        where nothing is asked of them. ``weight``: of such a pixel's alpha beside the mean error
        of another pixel's colours."""
        if self.ignored is None or not weight:
            return None
        counted = self.ignored.numel() - int(self.ignored.sum())
        return self.ignored * (weight / max(1, counted))

    def covering(self, alpha: Tensor, weight: float, square_weight: float) -> Tensor | None:
        """(H, W) float32 dL/d(alpha) of ``weight`` times the mean error, L1 and ``square_weight``
        times its square, of the rendered ``alpha`` over the pixels that count, None where the view
        is opaque or nothing is asked. It says with every background what random ones say on
        average, and adds none of their noise."""
        if self.alpha is None or not weight:
            return None
        error = alpha - self.alpha.to(torch.float32) / 255.0
        counted = error.numel()
        if self.ignored is not None:
            error = error.masked_fill(self.ignored, 0.0)
            counted -= int(self.ignored.sum())
        return (weight / max(1, counted)) * (error.sign() + 2 * square_weight * error)

    def psnr(self, rendered: Tensor, wanted: Tensor) -> float:
        """PSNR in dB over the pixels that count, of (H, W, 3) against ``over``'s picture."""
        scale = 1 / 255.0 if wanted.dtype == torch.uint8 else 1.0
        difference = rendered - wanted.to(torch.float32) * scale
        if self.ignored is not None:
            difference = difference[~self.ignored]
        error = float(difference.square().mean()) if difference.numel() else 0.0
        return -10 * math.log10(max(error, 1e-10))


class Targets:
    """All views' pixels; those of a reduced resolution are made once, when first asked for, and
    only one reduced resolution is kept.

    Args:
        noise: share of the pixels that are made black or white, the same for the same ``seed``
            and name.
        shelf: where the pixels are kept; None: in memory. It changes no bit.
    """

    def __init__(
        self,
        views: Sequence[View],
        threads: int,
        noise: float = 0.0,
        seed: int = 0,
        shelf: Shelf | None = None,
    ):
        self._shelf = MemoryShelf() if shelf is None else shelf

        def load(view: View) -> _Kept:
            pixels = load_view(view)
            if noise:
                _salt_and_pepper(pixels.rgb, noise, [seed, zlib.crc32(view.name.encode())])
            return _Kept(_target(pixels), self._shelf)

        with ThreadPoolExecutor(max(1, threads)) as pool:
            self._full = list(
                track(pool.map(load, views), "reading views", len(views), unit="views")
            )
        self._factor = 1
        self._reduced: dict[int, _Kept] = {}

    @property
    def have_alpha(self) -> bool:
        return any(kept.has_alpha for kept in self._full)

    def hidden(self) -> list[int]:
        """Indices of the views of which no pixel counts."""
        return [index for index, kept in enumerate(self._full) if kept.hidden]

    def drop(self, indices: Sequence[int]) -> None:
        """Forget these views; the others move up."""
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
            self._reduced[index] = _Kept(reduced, self._shelf)
        return self._reduced[index].get()


class _Kept:
    """A target on a shelf, and what is asked of it without a look."""

    def __init__(self, target: Target, shelf: Shelf):
        self.has_alpha = target.alpha is not None
        self.hidden = target.ignored is not None and bool(target.ignored.all())
        self._take: Callable[[], Planes] = shelf.put((target.rgb, target.alpha, target.ignored))

    def get(self) -> Target:
        rgb, alpha, ignored = self._take()
        assert rgb is not None
        return Target(rgb, alpha, ignored)


def usable_factor(views: Sequence[View], factor: int) -> int:
    """``factor``, halved until every view keeps ``MIN_SHORT_SIDE`` pixels (or 1 is reached)."""
    shortest = min(min(view.width, view.height) for view in views)
    while factor > 1 and shortest / factor < MIN_SHORT_SIDE:
        factor //= 2
    return factor


def _salt_and_pepper(rgb: NDArray[np.uint8], share: float, seed: list[int]) -> None:
    """Make this share of the pixels of (H, W, 3) black or white, in place."""
    draw = np.random.Generator(np.random.PCG64(seed)).random(rgb.shape[:2])
    rgb[draw < share / 2] = 0
    rgb[draw > 1 - share / 2] = 255


def _target(pixels: ViewPixels) -> Target:
    rgb, alpha = pixels.rgb, pixels.alpha
    ignored = None if pixels.mask is None or pixels.mask.all() else ~pixels.mask
    if alpha is not None:
        rgb = np.rint(rgb * (alpha[..., None].astype(np.float32) / 255.0)).astype(np.uint8)
    if ignored is not None:
        # SSIM's windows reach across a mask's edge: what lies behind must be the same everywhere.
        rgb = np.where(ignored[..., None], np.uint8(0), rgb)
        alpha = None if alpha is None else np.where(ignored, np.uint8(255), alpha)
    if alpha is not None and alpha.min() == 255:
        alpha = None
    return Target(_tensor(rgb), _tensor_or_none(alpha), _tensor_or_none(ignored))


def _reduce(target: Target, factor: int) -> Target:
    """The mean of the pixels that count; a reduced pixel is ignored if fewer than half of those
    under it do."""
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
