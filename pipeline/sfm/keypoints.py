"""Keypoints of one photograph and their file format."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.atomic import written


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of one photograph, largest scale first.

    Attributes:
        xy: (F, 2) float32, pixels of the stored image (before EXIF orientation), pixel centres at
            .5.
        scale: (F,) float32, sigma in pixels.
        orientation: (F,) float32, radians.
        descriptors: (F, 128) uint8, RootSIFT times 512.
        rgb: (F, 3) uint8, colour of the photograph at the keypoint.
    """

    xy: NDArray[np.float32]
    scale: NDArray[np.float32]
    orientation: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    rgb: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.xy)

    def write(self, path: Path) -> None:
        """Write as ``.npz``, atomically and deterministically."""
        with written(path) as file:
            np.savez(file, **vars(self))

    @staticmethod
    def read(path: Path) -> Keypoints:
        """Read a file that ``write`` wrote."""
        with np.load(path, allow_pickle=False) as data:
            return Keypoints(**{name: data[name] for name in Keypoints.__dataclass_fields__})


def keypoint_file(folder: Path, name: str) -> Path:
    """Path of the keypoint file of the photograph ``name``; distinct for distinct names."""
    stem = quote(name, safe="")
    # File systems limit names to 255 bytes.
    if len(stem) > 200:
        stem = hashlib.sha256(name.encode()).hexdigest()
    return folder / f"{stem}.npz"


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RootSIFT (Arandjelovic and Zisserman 2012) times 512, as COLMAP stores it.

    Args:
        descriptors: (F, 128) SIFT descriptors of any scale.
    """
    sums = np.maximum(np.abs(descriptors).sum(axis=1, keepdims=True), 1e-12)
    return np.clip(np.rint(512 * np.sqrt(descriptors / sums)), 0, 255).astype(np.uint8)
