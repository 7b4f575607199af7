"""The blocks of a scene that is trained in parts (``partition.json``).

Blocks are boxes that fill space: each point belongs to exactly one. Faces at the outside of the
scene are at infinity, so that distant surroundings belong to the outer blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.runtime.json_file import JsonFile, JsonObject, Matrix3, Vector3

Array = NDArray[np.float64]
Bound = float | None
Bounds = tuple[Bound, Bound, Bound]

_POINTS_AT_ONCE = 1 << 15


@dataclass(frozen=True)
class Box:
    """Points with ``lower <= axes @ point < upper``.

    Attributes:
        axes: (3, 3) float64, the box's directions as rows, orthonormal.
        lower, upper: (3,) float64, world units along ``axes``; infinite where it is unbounded.
    """

    axes: Array
    lower: Array
    upper: Array

    def along_axes(self, points: NDArray[Any]) -> Array:
        """(N, 3) points of the world, along the box's axes."""
        # Use einsum, not a matrix product: BLAS may round differently with the number of threads.
        return np.einsum("ij,nj->ni", self.axes, np.asarray(points, np.float64))

    def contains(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """(N,) whether each of (N, 3) points is in the box."""
        local = self.along_axes(points)
        return np.asarray(((local >= self.lower) & (local < self.upper)).all(1))

    def expanded(self, below: Array, above: Array) -> Box:
        """The box with its faces moved outwards by (3,) distances."""
        return Box(self.axes, self.lower - below, self.upper + above)

    def clipped(self, lower: Array, upper: Array) -> Box:
        """Its part within (3,) bounds along the axes."""
        return Box(self.axes, np.maximum(self.lower, lower), np.minimum(self.upper, upper))

    def crossed(self, origin: Array, directions: Array) -> tuple[Array, Array]:
        """(N,) distances, in lengths of ``directions`` (N, 3), at which rays from ``origin`` (3,)
        enter the box and leave it; those that miss it leave before they enter."""
        start, along = self.along_axes(origin[None]), self.along_axes(directions)
        along = np.where(along == 0, np.finfo(np.float64).tiny, along)
        with np.errstate(over="ignore"):
            first, second = (self.lower - start) / along, (self.upper - start) / along
        return np.minimum(first, second).max(1), np.maximum(first, second).min(1)

    def hides(self, origin: Array, points: Array) -> NDArray[np.bool_]:
        """(N,) whether each of (N, 3) points outside of the box is farther from ``origin`` (3,)
        than the point of the box that is nearest to it: what surrounds it is behind the box, where
        they overlap in an image."""
        start = self.along_axes(origin[None])
        hidden = np.empty(len(points), bool)
        # A part at a time, for less memory.
        for first in range(0, len(points), _POINTS_AT_ONCE):
            rows = slice(first, first + _POINTS_AT_ONCE)
            local = self.along_axes(points[rows])
            nearest = np.clip(local, self.lower, self.upper)
            hidden[rows] = ((nearest - start) ** 2).sum(1) < ((local - start) ** 2).sum(1)
        return hidden


class BlockView(JsonObject):
    """A training view of a block."""

    name: str = Field(description="Name of the view.")
    window: tuple[int, int, int, int] = Field(
        description="Left, top, width and height of the part that the block is seen in, pixels."
    )
    size: tuple[int, int] = Field(description="Width and height of the view, pixels.")
    share: float = Field(
        description="Share of the view's pixels that the block explains, in front of others."
    )

    def window_in(self, width: int, height: int) -> tuple[int, int, int, int]:
        """Left, top, right and bottom of the window in the view at another size, pixels; only
        pixels that are completely inside of it."""
        left, top, window_width, window_height = self.window
        sx, sy = width / self.size[0], height / self.size[1]
        return (
            math.ceil(left * sx),
            math.ceil(top * sy),
            math.floor((left + window_width) * sx),
            math.floor((top + window_height) * sy),
        )


class Block(JsonObject):
    """A block: a box, its margin, and the views that it is trained on."""

    lower: Bounds = Field(description="Lower faces along the axes, world units; null: infinite.")
    upper: Bounds = Field(description="Upper faces along the axes, world units; null: infinite.")
    margin_below: tuple[float, float, float] = Field(
        description="Distances by which its training region extends beyond the lower faces."
    )
    margin_above: tuple[float, float, float] = Field(
        description="Distances by which its training region extends beyond the upper faces."
    )
    gaussians: int = Field(description="Number of coarse Gaussians in the training region.")
    max_gaussians: int = Field(description="Upper limit of the number of trained Gaussians.")
    steps: int = Field(description="Number of optimiser steps.")
    views: tuple[BlockView, ...] = Field(description="Its training views, sorted by name.")
    overviews: tuple[str, ...] = Field(
        description="Views that look through its training region outside of their windows. These "
        "parts are trained on at reduced size, so that nothing appears in them."
    )

    def window_of(self, view: str) -> BlockView | None:
        """Its view with this name; None if the block is not seen in it."""
        return next((shown for shown in self.views if shown.name == view), None)

    @property
    def pixels(self) -> int:
        """Number of pixels of all windows."""
        return sum(view.window[2] * view.window[3] for view in self.views)


class Partition(JsonFile, JsonObject):
    """The blocks of a scene, numbered from 1."""

    file_name: ClassVar[str] = "partition.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    axes: Matrix3 = Field(description="Directions of the blocks' faces as rows, orthonormal.")
    lower: Vector3 = Field(description="Lower bounds of the scene along the axes, world units.")
    upper: Vector3 = Field(
        description="Upper bounds of the scene along the axes, world units. The far field, beyond "
        "the bounds, stays as the coarse run leaves it."
    )
    blocks: tuple[Block, ...] = Field(description="The blocks.")

    @property
    def bounds(self) -> Box:
        """The scene without its far field."""
        return Box(np.array(self.axes), np.array(self.lower), np.array(self.upper))

    def box(self, number: int) -> Box:
        """The box of block ``number``."""
        block = self.blocks[number - 1]
        lower = [-np.inf if bound is None else bound for bound in block.lower]
        upper = [np.inf if bound is None else bound for bound in block.upper]
        return Box(np.array(self.axes), np.array(lower), np.array(upper))

    def numbers(self, points: NDArray[Any]) -> NDArray[np.intp]:
        """(N,) the number of the block whose box each of (N, 3) points is in."""
        found = np.zeros(len(points), np.intp)
        for number in range(1, len(self.blocks) + 1):
            found[self.box(number).contains(points)] = number
        return found

    def kept(self, number: int) -> Box:
        """The box of block ``number`` within the scene's bounds: where its Gaussians stay in the
        union of the blocks."""
        return self.box(number).clipped(np.array(self.lower), np.array(self.upper))

    def region(self, number: int) -> Box:
        """The box of block ``number`` with its margin, within the scene's bounds: where its
        Gaussians are trained."""
        block = self.blocks[number - 1]
        margins = np.array(block.margin_below), np.array(block.margin_above)
        return self.box(number).expanded(*margins).clipped(*map(np.array, (self.lower, self.upper)))


def bounds_of(values: Array) -> Bounds:
    """(3,) faces of a box, for a file."""
    first, second, third = (float(v) if np.isfinite(v) else None for v in values)
    return first, second, third
