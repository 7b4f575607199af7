"""The COLMAP models of a scene folder, of which one is used."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from pipeline.io.colmap import has_model

_PLACES = ("sparse", "colmap/sparse")
# The model of the photographs in input/, before undistortion, as 3D Gaussian Splatting keeps it.
_BEFORE_UNDISTORTION = "distorted/sparse"
_COUNT = re.compile(r"^# Number of images: (\d+)", re.MULTILINE)
_HEAD_BYTES = 4096


def model_folders(folder: Path) -> list[str]:
    """The folders that may hold a model, relative to the scene folder: sparse/0 and so on."""
    places = list(_PLACES)
    if not (folder / "images").is_dir():
        places.append(_BEFORE_UNDISTORTION)
    found = []
    for place in places:
        root = folder / place
        numbered = [p.name for p in root.iterdir() if p.name.isdecimal()] if root.is_dir() else []
        found += [f"{place}/{name}" for name in sorted(numbered, key=lambda n: (int(n), n))]
        found.append(place)
    return found


def find_models(folder: Path) -> list[tuple[str, int]]:
    """The folders of the models, with their numbers of images: the largest first, and of equally
    large ones the first of ``model_folders``."""
    models = [path for path in model_folders(folder) if has_model(folder / path)]
    counted = [(path, number_of_images(folder / path) if len(models) > 1 else 0) for path in models]
    return sorted(counted, key=lambda entry: -entry[1])


def number_of_images(model: Path) -> int:
    """The number of images according to the header of a model's file of images; 0 if it has
    none."""
    if (model / "cameras.bin").is_file() and (model / "images.bin").is_file():
        with (model / "images.bin").open("rb") as stream:
            head = stream.read(8)
        return int(struct.unpack("<Q", head)[0]) if len(head) == 8 else 0
    with (model / "images.txt").open(encoding="utf-8", errors="replace") as text:
        found = _COUNT.search(text.read(_HEAD_BYTES))
        if found is not None:
            return int(found[1])
        text.seek(0)
        return sum(1 for line in text if line.strip() and line[0] != "#") // 2
