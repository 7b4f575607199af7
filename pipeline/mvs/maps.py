"""Depth maps of the dense stage: ``maps/<photograph>.npz`` and the fused cloud ``points.npz``.

A map has five bytes a pixel: depth as 16-bit logarithm between the map's smallest and largest depth
(steps of 1e-4 for a range of 1 to 1000), the normal in two bytes by the octahedral projection
(Cigolle et al. 2014), and confidence in one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.atomic import written
from pipeline.runtime.errors import UserError
from pipeline.runtime.record import rerun
from pipeline.scene.views import View

MAPS, POINTS = "maps", "points.npz"
# Codes of depth: 0 is unknown.
_STEPS = 2**16 - 2


@dataclass(frozen=True)
class DenseMap:
    """What multi-view stereo found in a view, at the view's size.

    Attributes:
        depth: (H, W) float32 camera z at pixel centres, scene units; 0 if unknown.
        normals: (H, W, 3) float32 unit normals in camera coordinates, towards the camera; 0 where
            the depth is unknown.
        confidence: (H, W) float32 in [0, 1] (``consistency.confidence``); 0 where the depth is
            unknown.
    """

    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    confidence: NDArray[np.float32]


@dataclass(frozen=True)
class DenseCloud:
    """The fused point cloud.

    Attributes:
        xyz: (N, 3) float32, world.
        normals: (N, 3) float32 unit normals in the world, towards the cameras.
        rgb: (N, 3) uint8.
    """

    xyz: NDArray[np.float32]
    normals: NDArray[np.float32]
    rgb: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.xyz)


def write_map(folder: Path, name: str, found: DenseMap) -> None:
    """Write the map of a photograph into the stage's ``folder``, atomically and
    deterministically."""
    known = found.depth > 0
    span = np.zeros(2)
    if known.any():
        span = np.log([float(found.depth[known].min()), float(found.depth[known].max())])
    width = max(float(span[1] - span[0]), 1e-12)
    logs = np.log(np.where(known, found.depth, 1.0).astype(np.float64))
    code = np.rint((logs - span[0]) / width * _STEPS).clip(0, _STEPS)
    confidence = np.rint(255 * found.confidence.clip(0, 1)).astype(np.uint8)
    with written(_map_file(folder, name)) as file:
        np.savez_compressed(
            file,
            log_depth=np.where(known, code + 1, 0).astype(np.uint16),
            span=span,
            normals=_octahedral(found.normals),
            confidence=np.where(known, np.maximum(confidence, 1), 0).astype(np.uint8),
        )


def read_map(folder: Path, name: str) -> DenseMap:
    """The map of a photograph from the folder of the dense stage.

    Raises:
        UserError: the file is missing or damaged.
    """
    arrays = _read(_map_file(folder, name), ("log_depth", "span", "normals", "confidence"))
    depth = _depth_of(arrays)
    normals = _from_octahedral(arrays["normals"])
    normals[depth == 0] = 0
    confidence = arrays["confidence"].astype(np.float32) / 255
    return DenseMap(depth, normals, np.asarray(confidence, np.float32))


def read_depth_of_map(folder: Path, name: str) -> NDArray[np.float32]:
    """``read_map(...).depth``, without reading the rest.

    Raises:
        UserError: the file is missing or damaged.
    """
    return _depth_of(_read(_map_file(folder, name), ("log_depth", "span")))


def _depth_of(arrays: dict[str, NDArray]) -> NDArray[np.float32]:
    code, span = arrays["log_depth"], arrays["span"]
    width = max(float(span[1] - span[0]), 1e-12)
    depth = np.exp(span[0] + (code.astype(np.float64) - 1) / _STEPS * width)
    return np.asarray(np.where(code > 0, depth, 0), np.float32)


def write_dense_cloud(folder: Path, cloud: DenseCloud) -> None:
    """Write ``points.npz``, atomically and deterministically."""
    with written(folder / POINTS) as file:
        np.savez(file, **vars(cloud))


def read_dense_cloud(folder: Path) -> DenseCloud:
    """The fused cloud from the folder of the dense stage.

    Raises:
        UserError: the file is missing or damaged.
    """
    return DenseCloud(**_read(folder / POINTS, ("xyz", "normals", "rgb")))


def planes_of(depth: NDArray[np.float32], normals: NDArray[np.float32], view: View) -> NDArray:
    """(3, H, W) float32 planes of depths and normals in camera coordinates: inverse depth and its
    gradient per pixel; 0 where the depth is unknown."""
    known = depth > 0
    x = (np.arange(view.width, dtype=np.float32) + 0.5 - view.cx) / view.fx
    y = ((np.arange(view.height, dtype=np.float32) + 0.5 - view.cy) / view.fy)[:, None]
    facing = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2]
    usable = known & (facing < -1e-3)
    inverse = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0)
    # The plane n . X = c with X = z ray: 1 / z = n . ray / c, and c = z n . ray.
    factor = np.where(usable, inverse / np.where(usable, facing, 1.0), 0.0)
    planes = [inverse, factor * normals[..., 0] / view.fx, factor * normals[..., 1] / view.fy]
    return np.stack(planes).astype(np.float32)


def _map_file(folder: Path, name: str) -> Path:
    return folder / MAPS / f"{name}.npz"


def _read(path: Path, names: tuple[str, ...]) -> dict[str, NDArray]:
    try:
        with np.load(path) as archive:
            return {name: archive[name] for name in names}
    except FileNotFoundError:
        raise UserError(
            "expected an output of stage dense, found none", file=path, fix=rerun(path.parent)
        ) from None
    except Exception as error:  # zipfile and numpy raise many types on damaged files.
        raise UserError(
            f"expected arrays of stage dense, found a damaged file ({error})",
            file=path,
            fix=rerun(path.parent),
        ) from None


def _octahedral(normals: NDArray[np.float32]) -> NDArray[np.int8]:
    """(H, W, 2) int8: the octahedron |x| + |y| + |z| = 1, its lower half folded outwards."""
    n = normals / np.maximum(np.abs(normals).sum(-1, keepdims=True), 1e-12)
    folded = (1 - np.abs(n[..., 1::-1])) * np.where(n[..., :2] < 0, -1, 1)
    square = np.where(n[..., 2:] < 0, folded, n[..., :2])
    return np.rint(127 * square).astype(np.int8)


def _from_octahedral(code: NDArray[np.int8]) -> NDArray[np.float32]:
    square = code.astype(np.float32) / 127
    z = 1 - np.abs(square).sum(-1, keepdims=True)
    folded = (1 - np.abs(square[..., ::-1])) * np.where(square < 0, -1, 1)
    n = np.concatenate([np.where(z < 0, folded, square), z], axis=-1)
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True), np.float32)
