"""Photographs of the corner of a textured room, with exactly known cameras."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from pipeline.geometry.cameras import Camera
from pipeline.io.recorded import digest_of
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction

WIDTH, HEIGHT, FOCAL = 400, 300, 380.0
_TEXTURE = 512
# Origin and the two edges (unit length) of the floor and the two walls; the corner is at 0.
_PLANES = [
    (np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, -1.0])),
    (np.zeros(3), np.array([1.0, 0, 0]), np.array([0, -1.0, 0])),
    (np.zeros(3), np.array([0, 0, -1.0]), np.array([0, -1.0, 0])),
]


def camera() -> Camera:
    params = np.array([FOCAL, WIDTH / 2, HEIGHT / 2, 0.0])
    return Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, params)


def poses(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """World to camera poses on a rising and falling arc, directed at the corner."""
    found = []
    for angle in np.linspace(np.radians(15), np.radians(75), count):
        height = -0.7 - 0.5 * np.sin(3 * angle)
        centre = np.array([2.2 * np.cos(angle), height, -2.2 * np.sin(angle)])
        forward = np.array([0.35, -0.35, -0.35]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, -1.0, 0.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        found.append((rotation, -rotation @ centre))
    return found


@lru_cache
def texture(seed: int) -> np.ndarray:
    """(512, 512, 3) uint8: random blobs of several sizes."""
    rng = np.random.default_rng(seed)
    total = np.zeros((_TEXTURE, _TEXTURE, 3))
    for cells in (16, 32, 64, 128):
        coarse = rng.uniform(-1, 1, (cells, cells, 3)).astype(np.float32)
        total += cv2.resize(coarse, (_TEXTURE, _TEXTURE), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 70 * total, 0, 255).astype(np.uint8)


def picture(rotation: np.ndarray, translation: np.ndarray, seed: int) -> np.ndarray:
    """(300, 400, 3) uint8 BGR render of the corner, supersampled twice."""
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    larger = np.diag([2.0, 2.0, 1.0])
    # From coordinates (pixel centres at .5) to array indices, of textures and images.
    to_index = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
    image = np.zeros((2 * HEIGHT, 2 * WIDTH, 3), np.uint8)
    for index, (origin, u, v) in enumerate(_PLANES):
        plane = np.column_stack([u, v, origin]) / [_TEXTURE, _TEXTURE, 1]
        projection = rotation @ plane
        projection[:, 2] += translation
        homography = to_index @ larger @ intrinsics @ projection @ np.linalg.inv(to_index)
        drawn = texture(10 * seed + index)
        size = (2 * WIDTH, 2 * HEIGHT)
        layer = cv2.warpPerspective(drawn, homography, size, flags=cv2.INTER_LINEAR)
        covered = cv2.warpPerspective(np.full_like(drawn[..., 0], 255), homography, size)
        image[covered == 255] = layer[covered == 255]
    return cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def photo(path: Path, name: str | None = None, **facts) -> Photo:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    return Photo(
        name=name or path.name,
        path=str(path),
        width=pixels.shape[1],
        height=pixels.shape[0],
        digest=digest_of(path),
        **facts,
    )


def write_scene(
    folder: Path, count: int, *, seed: int = 1, prefix: str = "view ", **facts
) -> tuple[list[Photo], Reconstruction]:
    """Write ``count`` PNG photographs, with spaces in their names."""
    folder.mkdir(parents=True, exist_ok=True)
    photos, images = [], {}
    for index, (rotation, translation) in enumerate(poses(count), start=1):
        path = folder / f"{prefix}{index:02d}.png"
        cv2.imwrite(str(path), picture(rotation, translation, seed))
        photos.append(photo(path, **facts))
        images[index] = PosedImage(path.name, 1, rotation, translation)
    return photos, Reconstruction({1: camera()}, images)


def manifest(photos: list[Photo]) -> Manifest:
    return Manifest(scene="corner", photos=tuple(sorted(photos, key=lambda p: p.name)))
