"""The search for transients during training: when, and what is kept of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.photos.found_masks import enlarged
from pipeline.scene.views import View, reduced_size
from pipeline.training.data.targets import Target
from pipeline.training.transients.evidence import (
    Evidence,
    ReducedPhotographs,
    expected,
    gather,
    weights_of,
)
from pipeline.training.transients.patches import Mask, confirmed, contradicted, has_core, widened

#: Transients are searched for after these shares of a run. What the first search finds is only
#: remembered.
RUN_SHARES = 0.12, 0.2, 0.5
#: Fewer views do not show which of them is wrong. Runs of fewer epochs would spend too large a part
#: of their time on the search.
MIN_VIEWS, MIN_EPOCHS = 8, 30
#: Patches of together less than this share of all pixels are errors of the scene, and all are used.
MIN_SCENE_SHARE = 2e-3
#: Images are reduced by a power of two, to at least so many pixels on the shorter side.
SHORT_SIDE = 90
#: A Gaussian explains transients if more than this share of its weight, and more than so many
#: pixels of the reduced images, are in patches.
HIDDEN_SHARE, MIN_HIDDEN = 0.5, 0.1


@dataclass
class Transients:
    """The patches of the training views that show transients, at the reduced size.

    Attributes:
        steps: The length of the schedule.
        found: (H, W) bool of each view: what the last search found.
        masks: (H, W) bool of each view: the pixels that are left out of the loss.
        version: The number of searches of this process that changed ``masks``.
    """

    steps: int
    found: list[Mask]
    masks: list[Mask]
    version: int = field(default=0, compare=False)

    @staticmethod
    def of(views: Sequence[View], steps: int) -> Transients:
        """Nothing is found yet."""
        factor = reduction(views)
        sizes = [reduced_size(view, factor) for view in views]
        found, masks = ([np.zeros((h, w), bool) for w, h in sizes] for _ in range(2))
        return Transients(steps, found, masks)

    def is_due(self, steps: range, run_length: float) -> bool:
        """Whether transients are searched for after these steps of the schedule.

        Args:
            run_length: The expected number of optimiser steps of the run.
        """
        if run_length < MIN_EPOCHS * len(self.masks):
            return False
        due = [share for share in RUN_SHARES if round(share * self.steps) in steps]
        # The last search only confirms what the one before has found.
        return bool(due) and (due[0] < RUN_SHARES[-1] or any(mask.any() for mask in self.found))

    def search(self, photographs: ReducedPhotographs) -> Tensor:
        """Find the patches that the last search found as well, and leave them out of the loss.

        Returns:
            (N,) bool, the Gaussians that explain transients (``explaining``).
        """
        evidence = gather(photographs)
        found = [
            contradicted(view, expected(photographs, evidence, index), before)
            if has_core(view.residual)
            else np.zeros_like(before)
            for index, (view, before) in enumerate(zip(evidence.views, self.found, strict=True))
        ]
        masks = [confirmed(now, before) for now, before in zip(found, self.found, strict=True)]
        if share_of(masks) < MIN_SCENE_SHARE:
            masks = [np.zeros_like(mask) for mask in masks]
        self.found, self.masks = found, [widened(mask) for mask in masks]
        self.version += 1
        return explaining(photographs, evidence, self.masks)

    def applied(self, target: Target, index: int) -> Target:
        """The pixels of view ``index`` at any size, without its transients."""
        if not self.masks[index].any():
            return target
        height, width = target.rgb.shape[:2]
        transient = torch.from_numpy(enlarged(self.masks[index], width, height))
        ignored = transient if target.ignored is None else transient | target.ignored
        return replace(target, ignored=ignored, transient=transient)

    def by_name(self, views: Sequence[View]) -> dict[str, Mask]:
        """(H, W) bool at the size of the view, true for transients, of the views that show any."""
        return {
            view.name: enlarged(mask, view.width, view.height)
            for view, mask in zip(views, self.masks, strict=True)
            if mask.any()
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a checkpoint."""
        return {"transients.found": _packed(self.found), "transients.masks": _packed(self.masks)}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Restore the state that ``arrays()`` returned; other keys are ignored."""
        self.found = _unpacked(arrays["transients.found"], self.found)
        self.masks = _unpacked(arrays["transients.masks"], self.masks)


def reduction(views: Sequence[View]) -> int:
    """The factor by which images are reduced."""
    shortest = min(min(view.width, view.height) for view in views)
    factor = 1
    while shortest >= 2 * factor * SHORT_SIDE:
        factor *= 2
    return factor


def share_of(masks: Sequence[Mask]) -> float:
    """The share of the pixels of all views that is true."""
    return sum(int(mask.sum()) for mask in masks) / max(1, sum(mask.size for mask in masks))


def explaining(
    photographs: ReducedPhotographs, evidence: Evidence, masks: Sequence[Mask]
) -> Tensor:
    """(N,) bool, the Gaussians with most of their weight in ``masks``: they are in front of the
    scene in the views with transients, and nothing else needs them."""
    hidden = torch.zeros_like(evidence.weight)
    for index, mask in enumerate(masks):
        if mask.any():
            image = mask.astype(np.float32)
            rendered = photographs.render(index)
            hidden += weights_of(rendered, (image, image), photographs.backend)[0]
    return (hidden > HIDDEN_SHARE * evidence.weight) & (hidden > MIN_HIDDEN)


def _packed(masks: Sequence[Mask]) -> NDArray[np.uint8]:
    """The pixels of all masks, eight in a byte."""
    return np.packbits(np.concatenate([mask.ravel() for mask in masks]))


def _unpacked(packed: NDArray[np.uint8], like: Sequence[Mask]) -> list[Mask]:
    ends = np.cumsum([mask.size for mask in like])
    pixels = np.unpackbits(packed, count=int(ends[-1])).astype(bool)
    parts = np.split(pixels, ends[:-1])
    return [part.reshape(mask.shape) for part, mask in zip(parts, like, strict=True)]
