"""Streamed SOG, version 1: a folder of chunks of the scene at several levels of detail.

``lod-meta.json`` has a binary tree of boxes. Each leaf has a folder of SOG files for each level,
``LEVEL_LEAF/``: level 0 has all Gaussians of the leaf, each further one half as many
(``splats.levels``). Viewers load the levels that a camera needs. Source of the layout:
developer.playcanvas.com, "Streamed SOG".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.io.sog import write_sog
from pipeline.io.sog_container import META, Asset
from pipeline.runtime.atomic import write_text
from pipeline.runtime.json_file import JsonObject, Vector3
from pipeline.splats.arrays import GaussianArrays, GaussianRows, collect
from pipeline.splats.chunks import LEAF, Rows, box, halves, in_z_order
from pipeline.splats.levels import halved

LOD_META = "lod-meta.json"
#: The number of levels of detail; each has half of the Gaussians of the one before.
LEVELS = 5


class Bound(JsonObject):
    """A box along the axes that contains the Gaussians up to one standard deviation."""

    min: Vector3
    max: Vector3


class Part(JsonObject):
    """The Gaussians of a leaf at a level.

    Attributes:
        file: The index in ``LodMeta.filenames``.
        offset, count: The first Gaussian in the file, and the number of them.
    """

    file: int = Field(ge=0)
    offset: int = Field(ge=0)
    count: int = Field(ge=1)


class Node(JsonObject):
    """A box of the tree: it has two children, or the levels of a leaf by number."""

    bound: Bound
    children: tuple[Node, Node] | None = None
    lods: dict[str, Part] | None = None


class LodMeta(JsonObject):
    """``lod-meta.json``."""

    version: Literal[1] = 1
    asset: Asset
    count: int = Field(ge=1)
    counts: tuple[int, ...]
    lodLevels: int = Field(ge=1)
    filenames: tuple[str, ...]
    tree: Node


@dataclass
class _Written:
    """The files and counts of the leaves that were written."""

    filenames: list[str]
    counts: list[int]


def write_streamed_sog(folder: Path, gaussians: GaussianRows, *, antialias: bool = False) -> None:
    """Write Gaussians as Streamed SOG: the leaves one after the other, then ``lod-meta.json``.

    Args:
        folder: The folder, which is made.
        gaussians: The Gaussians, at least one, in the world's axes.
        antialias: Whether the Gaussians were trained with Mip-Splatting's opacity compensation.
    """
    written = _Written([], [0] * LEVELS)
    tree = _write_node(folder, gaussians, gaussians.rows, written, antialias)
    meta = LodMeta(
        asset=Asset(generator="splatmake"),
        count=sum(written.counts),
        counts=tuple(written.counts),
        lodLevels=LEVELS,
        filenames=tuple(written.filenames),
        tree=tree,
    )
    write_text(folder / LOD_META, meta.model_dump_json(exclude_none=True))


def _write_node(
    folder: Path, gaussians: GaussianRows, rows: Rows, written: _Written, antialias: bool
) -> Node:
    if len(rows) > LEAF:
        parts = halves(gaussians.source.means, rows)
        first, second = (_write_node(folder, gaussians, p, written, antialias) for p in parts)
        bounds = np.array([[node.bound.min, node.bound.max] for node in (first, second)])
        bound = _bound(bounds[:, 0].min(0), bounds[:, 1].max(0))
        return Node(bound=bound, children=(first, second))
    number, lods = len(written.filenames) // LEVELS, {}
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for level, made in enumerate(_levels(collect(replace(gaussians, rows=rows)))):
        name = f"{level}_{number}/{META}"
        write_sog(folder / name, made, antialias=antialias)
        corners = box(made, 1.0)
        low, high = np.minimum(low, corners[0]), np.maximum(high, corners[1])
        lods[str(level)] = Part(file=len(written.filenames), offset=0, count=len(made))
        written.filenames.append(name)
        written.counts[level] += len(made)
    return Node(bound=_bound(low, high), lods=lods)


def _levels(gaussians: GaussianArrays) -> Iterator[GaussianArrays]:
    """The levels of a leaf from the finest, in Morton order."""
    for level in range(LEVELS):
        if level:
            gaussians = halved(gaussians)
        gaussians = in_z_order(gaussians)
        yield gaussians


def _bound(low: NDArray[np.float64], high: NDArray[np.float64]) -> Bound:
    return Bound(min=_triple(low), max=_triple(high))


def _triple(values: NDArray[np.float64]) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z
