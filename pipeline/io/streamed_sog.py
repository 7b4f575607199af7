"""Streamed SOG, version 1: a folder of SOG files with the scene at several levels of detail.

``lod-meta.json`` has a tree of boxes. Each leaf has its Gaussians at each level: level 0 has all of
them, each further one half as many (``splats.levels``). A file, ``LEVEL_NUMBER/meta.json``, holds
one level of neighbouring leaves. Viewers load the files of the levels that a camera needs. The
coarsest level of the whole scene is one small file, which a viewer can show first.
``env/meta.json`` has what is always shown: the sky, where it has few Gaussians. Sources:
developer.playcanvas.com, "Streamed SOG", and the engine's loader (``gsplat-octree.js``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.io.sog import write_sog
from pipeline.io.sog_container import META, Asset
from pipeline.runtime.atomic import write_text
from pipeline.runtime.json_file import JsonObject, Vector3
from pipeline.runtime.progress import Progress
from pipeline.splats.arrays import NAMES, GaussianArrays, GaussianRows, collect
from pipeline.splats.chunks import Chunk, box, chunks_of, levels_of

LOD_META = "lod-meta.json"
ENVIRONMENT = f"env/{META}"
#: The smallest number of levels of detail; each has half of the Gaussians of the one before.
LEVELS = 5
#: The largest number of Gaussians of a leaf.
LEAF = 1 << 14
#: The largest number of Gaussians of a file.
FILE = 1 << 16
#: The largest number of Gaussians of the environment, and of the coarsest level but for rounding up
#: in each leaf. Viewers draw both in the first picture, also those without a GPU.
FIRST_PICTURE = 1 << 13


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
    """A box of the tree: it has children, or the levels of a leaf by number."""

    bound: Bound
    children: tuple[Node, ...] | None = None
    lods: dict[str, Part] | None = None


class LodMeta(JsonObject):
    """``lod-meta.json``. The counts are without the environment."""

    version: Literal[1] = 1
    asset: Asset
    count: int = Field(ge=1)
    counts: tuple[int, ...]
    lodLevels: int = Field(ge=1)
    environment: str | None = None
    filenames: tuple[str, ...]
    tree: Node


def write_streamed_sog(
    folder: Path,
    gaussians: GaussianRows,
    *,
    blocks: NDArray[np.intp] | None = None,
    sky: NDArray[np.bool_] | None = None,
    antialias: bool = False,
) -> None:
    """Write Gaussians as Streamed SOG, leaf by leaf, then ``lod-meta.json``. Beside ``gaussians``,
    memory holds up to one unfinished file of each level.

    Args:
        folder: The folder, which is made.
        gaussians: The Gaussians, at least one, in the world's axes.
        blocks: (N,) the number of the block of each of ``gaussians``: the first branches of the
            tree, from 1 on. None for one block.
        sky: (N,) whether each is sky, which is always shown and has no levels. Where it has more
            than ``FIRST_PICTURE`` Gaussians, it is the first branch of the tree instead.
        antialias: Whether the Gaussians were trained with Mip-Splatting's opacity compensation.
    """
    environment = None
    if sky is not None and sky.sum() > FIRST_PICTURE:
        # If leaves of the scene contained sky, their boxes would be large.
        blocks = np.where(sky, 0, 1 if blocks is None else blocks)
    elif sky is not None and 0 < sky.sum() < len(gaussians):
        environment = ENVIRONMENT
        part = replace(gaussians, rows=gaussians.rows[sky])
        write_sog(folder / environment, part, antialias=antialias)
        gaussians = replace(gaussians, rows=gaussians.rows[~sky])
        blocks = None if blocks is None else blocks[~sky]
    tree = chunks_of(gaussians.source.means, gaussians.rows, LEAF, blocks)
    levels = [_Level() for _ in range(num_levels(len(gaussians)))]
    progress = Progress("writing levels of detail", len(gaussians), "Gaussians")
    files = _Files(folder, antialias, levels, progress)
    root = _write_node(gaussians, tree, files)
    for level in range(len(files.levels)):
        files.flush(level)
    counts = tuple(level.written for level in files.levels)
    meta = LodMeta(
        asset=Asset(generator="splatmake"),
        count=sum(counts),
        counts=counts,
        lodLevels=len(counts),
        environment=environment,
        filenames=tuple(files.names),
        tree=root,
    )
    write_text(folder / LOD_META, meta.model_dump_json(exclude_none=True))


def num_levels(count: int) -> int:
    """The number of levels of ``count`` Gaussians."""
    return max(LEVELS, 1 + (count // FIRST_PICTURE).bit_length())


@dataclass
class _Level:
    """The file of a level that is being filled: the leaves in it, its index in the list of files,
    and the number of Gaussians of the level so far."""

    parts: list[GaussianArrays] = field(default_factory=list)
    file: int = -1
    number: int = -1
    written: int = 0

    @property
    def count(self) -> int:
        return sum(map(len, self.parts))


@dataclass
class _Files:
    """The files of all levels."""

    folder: Path
    antialias: bool
    levels: list[_Level]
    progress: Progress
    names: list[str] = field(default_factory=list)

    def add(self, level: int, gaussians: GaussianArrays) -> Part:
        """Add a leaf to the file of a level, or to a new one where it is full."""
        state = self.levels[level]
        if state.parts and state.count + len(gaussians) > FILE:
            self.flush(level)
        if not state.parts:
            state.file, state.number = len(self.names), state.number + 1
            self.names.append(f"{level}_{state.number}/{META}")
        part = Part(file=state.file, offset=state.count, count=len(gaussians))
        state.parts.append(gaussians)
        state.written += len(gaussians)
        return part

    def flush(self, level: int) -> None:
        """Write the unfinished file of a level."""
        state = self.levels[level]
        arrays = {n: np.concatenate([getattr(p, n) for p in state.parts]) for n in NAMES}
        state.parts.clear()
        path = self.folder / self.names[state.file]
        write_sog(path, GaussianArrays(**arrays), antialias=self.antialias)


def _write_node(gaussians: GaussianRows, chunk: Chunk, files: _Files) -> Node:
    if chunk.children:
        children = tuple(_write_node(gaussians, child, files) for child in chunk.children)
        bounds = np.array([[node.bound.min, node.bound.max] for node in children])
        return Node(bound=_bound(bounds), children=children)
    lods: dict[str, Part] = {}
    boxes: list[NDArray[np.float64]] = []
    leaf = collect(replace(gaussians, rows=chunk.rows))
    for level, made in enumerate(levels_of(leaf, len(files.levels))):
        boxes.append(box(made, 1.0))
        lods[str(level)] = files.add(level, made)
    files.progress.advance(len(leaf))
    return Node(bound=_bound(np.array(boxes)), lods=lods)


def _bound(boxes: NDArray[np.float64]) -> Bound:
    """The box around (N, 2, 3) boxes."""
    return Bound(min=_triple(boxes[:, 0].min(0)), max=_triple(boxes[:, 1].max(0)))


def _triple(values: NDArray[np.float64]) -> Vector3:
    """With as many digits as float32 has: a large scene has tens of thousands of boxes."""
    x, y, z = (float(f"{value:.7g}") for value in values.tolist())
    return x, y, z
