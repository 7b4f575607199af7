"""The blocks of a scene that is trained in parts (``partition.json``).

Blocks are boxes that fill space: each point belongs to exactly one. Faces at the outside of the
scene are at infinity, so that distant surroundings belong to the outer blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.runtime.json_file import JsonFile, JsonObject, Matrix3

Array = NDArray[np.float64]
Bound = float | None
Bounds = tuple[Bound, Bound, Bound]


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
        # einsum, not a matrix product: BLAS may round differently with the number of threads.
        return np.einsum("ij,nj->ni", self.axes, np.asarray(points, np.float64))

    def contains(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """(N,) whether each of (N, 3) points is in the box."""
        local = self.along_axes(points)
        return np.asarray(((local >= self.lower) & (local < self.upper)).all(1))

    def expanded(self, below: Array, above: Array) -> Box:
        """The box with its faces moved outwards by (3,) distances."""
        return Box(self.axes, self.lower - below, self.upper + above)

    def hides(self, origin: Array, points: Array) -> NDArray[np.bool_]:
        """(N,) whether each of (N, 3) points outside of the box is farther from ``origin`` (3,)
        than the point of the box that is nearest to it: what surrounds it is behind the box, where
        they overlap in an image."""
        start, local = self.along_axes(origin[None]), self.along_axes(points)
        nearest = np.clip(local, self.lower, self.upper)
        return np.asarray(((nearest - start) ** 2).sum(1) < ((local - start) ** 2).sum(1))


class BlockView(JsonObject):
    """A training view of a block."""

    name: str = Field(description="Name of the view.")
    window: tuple[int, int, int, int] = Field(
        description="Left, top, width and height of the part that the block is seen in, pixels."
    )
    share: float = Field(
        description="Share of the view's pixels that the block explains, in front of others."
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

    @property
    def pixels(self) -> int:
        """Number of pixels of all windows."""
        return sum(view.window[2] * view.window[3] for view in self.views)


class Partition(JsonFile, JsonObject):
    """The blocks of a scene, numbered from 1."""

    file_name: ClassVar[str] = "partition.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    axes: Matrix3 = Field(description="Directions of the blocks' faces as rows, orthonormal.")
    blocks: tuple[Block, ...] = Field(description="The blocks.")

    def box(self, number: int) -> Box:
        """The box of block ``number``."""
        block = self.blocks[number - 1]
        lower = [-np.inf if bound is None else bound for bound in block.lower]
        upper = [np.inf if bound is None else bound for bound in block.upper]
        return Box(np.array(self.axes), np.array(lower), np.array(upper))

    def region(self, number: int) -> Box:
        """The box of block ``number`` with its margin: where its Gaussians are trained."""
        block = self.blocks[number - 1]
        return self.box(number).expanded(np.array(block.margin_below), np.array(block.margin_above))


def bounds_of(values: Array) -> Bounds:
    """(3,) faces of a box, for a file."""
    first, second, third = (float(v) if np.isfinite(v) else None for v in values)
    return first, second, third
