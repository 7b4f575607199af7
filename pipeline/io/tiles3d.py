"""3D Tiles 1.1: a tree of tiles of Gaussians at the scene's place on the earth.

``tileset.json`` has a binary tree. A tile has up to ``LEAF`` Gaussians: the leaves have those of
the scene, and each other tile those of its two children merged to half as many (``splats.levels``).
A viewer replaces a tile by its children when it comes near. Each tile is a .glb file whose
Gaussians are compressed as SPZ (KHR_gaussian_splatting_compression_spz_2), which CesiumJS reads.
Sources: docs.ogc.org, 22-025r4 (3D Tiles 1.1); github.com/CesiumGS/glTF, branch draft-splat-spz.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.io.gltf import GAUSSIAN_SPLATTING, glb, splat_rendering
from pipeline.io.spz import encode_spz
from pipeline.runtime.atomic import write_bytes, write_json
from pipeline.runtime.progress import Progress
from pipeline.splats.arrays import GaussianArrays, GaussianRows, collect, joined
from pipeline.splats.chunks import Chunk, box, chunks_of, in_z_order
from pipeline.splats.levels import halved

Array = NDArray[np.float64]

TILESET = "tileset.json"
#: The largest number of Gaussians of a tile.
LEAF = 1 << 17
_SPZ = "KHR_gaussian_splatting_compression_spz_2"
_EXTENSIONS = [GAUSSIAN_SPLATTING, _SPZ]
#: The half sides of the box of a Gaussian, in standard deviations.
_REACH = 3.0
# Viewers replace a tile when its geometric error exceeds 16 pixels (Cesium's default): the standard
# deviation of its typical Gaussian is a pixel then.
_ERROR_DEVIATIONS = 16.0
# SPZ is right, up, back. Viewers turn glTF's y up to z up: right, back, down of the world.
_TILE_OF_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass
class _Writer:
    """Writes tiles.

    Attributes:
        folder: The folder of the tileset.
        gaussians: All Gaussians.
        antialias: As in ``write_tiles3d``.
        progress: Counts the Gaussians of the leaves.
        written: The number of tiles that were written.
    """

    folder: Path
    gaussians: GaussianRows
    antialias: bool
    progress: Progress
    written: int = field(default=0)

    def write(self, chunk: Chunk) -> tuple[dict[str, Any], GaussianArrays, Array]:
        """Write the tile of a chunk, and those below it.

        Returns:
            The tile's entry in the tree; its Gaussians; (2, 3) corners of a box of the tile and
            those below it, world.
        """
        children: list[dict[str, Any]] = []
        if chunk.children:
            parts = [self.write(child) for child in chunk.children]
            children = [entry for entry, *_ in parts]
            own = halved(joined([gaussians for _, gaussians, _ in parts]))
            boxes = [corners for *_, corners in parts]
            error = max(
                _ERROR_DEVIATIONS * _typical_deviation(own),
                # A viewer replaces a tile before those below it.
                *(1.25 * entry["geometricError"] for entry in children),
            )
        else:
            own, boxes, error = collect(replace(self.gaussians, rows=chunk.rows)), [], 0.0
            self.progress.advance(len(own))
        corners = np.stack([box(own, _REACH), *boxes])
        corners = np.stack([corners[:, 0].min(0), corners[:, 1].max(0)])
        own = in_z_order(own)
        name = f"{self.written}.glb"
        self.written += 1
        write_bytes(self.folder / name, _tile(own, self.antialias))
        entry: dict[str, Any] = {
            "boundingVolume": {"box": _bounding_box(corners)},
            "geometricError": error,
            "content": {"uri": name},
        }
        if children:
            entry["children"] = children
        return entry, own, corners


def write_tiles3d(
    folder: Path, gaussians: GaussianRows, to_earth: Array, *, antialias: bool = False
) -> None:
    """Write Gaussians as 3D Tiles: tiles from the leaves to the root, then ``tileset.json``.

    Args:
        folder: The folder, which is made.
        gaussians: The Gaussians, at least one, in a world in metres.
        to_earth: (4, 4) affine transformation of the world to Earth-centred coordinates, metres.
        antialias: Whether the Gaussians were trained with Mip-Splatting's opacity compensation.
    """
    tree = chunks_of(gaussians.source.means, gaussians.rows, LEAF)
    progress = Progress("writing tiles", len(gaussians), "Gaussians")
    root, _, corners = _Writer(folder, gaussians, antialias, progress).write(tree)
    turned = np.eye(4)
    turned[:3, :3] = _TILE_OF_WORLD.T
    root["transform"] = (to_earth @ turned).T.ravel().tolist()
    root["refine"] = "REPLACE"
    extensions = {"extensionsUsed": _EXTENSIONS, "extensionsRequired": _EXTENSIONS}
    tileset = {
        "asset": {"version": "1.1", "generator": "splatmake"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": extensions},
        # The error of showing nothing.
        "geometricError": float(np.linalg.norm(corners[1] - corners[0])),
        "root": root,
    }
    write_json(folder / TILESET, tileset)


def _typical_deviation(gaussians: GaussianArrays) -> float:
    """The median of the Gaussians' largest standard deviations."""
    return float(np.exp(np.median(gaussians.log_scales.max(1)).astype(np.float64)))


def _bounding_box(corners: Array) -> list[float]:
    """Centre and half axes of a box along the world's axes, in the tile's."""
    turned = np.sort(corners @ _TILE_OF_WORLD.T, axis=0)
    centre, half = turned.mean(0), np.diag((turned[1] - turned[0]) / 2)
    return [*centre.tolist(), *half.ravel().tolist()]


def _tile(gaussians: GaussianArrays, antialias: bool) -> bytes:
    """A .glb file whose only buffer is an SPZ file."""
    packed = encode_spz(gaussians, antialias=antialias)
    count, names = len(gaussians), _attributes(gaussians.sh_degree)
    means = gaussians.means * np.array([1, -1, -1], np.float32)
    accessors = [
        {"componentType": component, "count": count, "type": kind} | extra
        for component, kind, extra in names.values()
    ]
    accessors[0] |= {"min": means.min(0).tolist(), "max": means.max(0).tolist()}
    extension = splat_rendering() | {"extensions": {_SPZ: {"bufferView": 0}}}
    primitive = {
        "attributes": {name: i for i, name in enumerate(names)},
        "mode": 0,
        "extensions": {GAUSSIAN_SPLATTING: extension},
    }
    document = {
        "asset": {"version": "2.0", "generator": "splatmake"},
        "extensionsUsed": _EXTENSIONS,
        "extensionsRequired": _EXTENSIONS,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": len(packed)}],
        "buffers": [{"byteLength": len(packed)}],
    }
    return glb(document, packed)


def _attributes(sh_degree: int) -> dict[str, tuple[int, str, dict[str, Any]]]:
    """Component type, type and further fields of the accessor of each attribute."""
    real = 5126
    found: dict[str, tuple[int, str, dict[str, Any]]] = {
        "POSITION": (real, "VEC3", {}),
        "COLOR_0": (5121, "VEC4", {"normalized": True}),
        f"{GAUSSIAN_SPLATTING}:ROTATION": (real, "VEC4", {}),
        f"{GAUSSIAN_SPLATTING}:SCALE": (real, "VEC3", {}),
    }
    for degree in range(1, sh_degree + 1):
        for i in range(2 * degree + 1):
            found[f"{GAUSSIAN_SPLATTING}:SH_DEGREE_{degree}_COEF_{i}"] = (real, "VEC3", {})
    return found
