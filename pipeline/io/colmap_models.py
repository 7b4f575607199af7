"""The COLMAP models of a scene folder, of which one is used."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from pipeline.io.colmap import format_of, has_model, model_files
from pipeline.io.folders import pictures_in
from pipeline.io.names import NameIndex
from pipeline.runtime.errors import UserError

_PLACES = ("sparse", "colmap/sparse")
# The model of the photographs in input/, before undistortion, as 3D Gaussian Splatting keeps it.
_BEFORE_UNDISTORTION = "distorted/sparse"
_COUNT = re.compile(r"^# Number of images: (\d+)", re.MULTILINE)
_HEAD_BYTES = 4096


@dataclass(frozen=True)
class FoundModel:
    """A COLMAP model in a scene folder.

    Attributes:
        path: The model's folder, relative to the scene folder.
        images: The number of images in the model; 0 if it was not counted.
        photographs: The number of these images that are photographs of the scene.
    """

    path: str
    images: int = 0
    photographs: int = 0

    @property
    def text(self) -> str:
        """The path and the numbers, in words."""
        some = f"{self.photographs} of " if self.photographs != self.images else ""
        return f"{self.path} ({some}{self.images} images)"


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


def find_models(folder: Path) -> list[FoundModel]:
    """The models, sorted: the one with the most photographs of the scene comes first.

    Of models with equally many photographs, the one with the most images comes first, then the
    first of ``model_folders``.
    """
    paths = [path for path in model_folders(folder) if has_model(folder / path)]
    if len(paths) < 2:
        return [FoundModel(path) for path in paths]
    index = NameIndex(pictures_in(folder))
    models = []
    for path in paths:
        file = model_files(folder / path)[1]
        state = file.stat()
        names = _image_names(file, state.st_mtime_ns, state.st_size)
        if names is None:  # A damaged file; if this model is chosen, reading it is an error.
            images = photographs = _declared_images(file)
        else:
            images, photographs = len(names), sum(bool(index.candidates(n)) for n in names)
        models.append(FoundModel(path, images, photographs))
    return sorted(models, key=lambda model: (-model.photographs, -model.images))


def text_files_beside_binary(model: Path) -> list[str]:
    """The names of the text files of a model that is read from its binary files, sorted."""
    if model_files(model)[0].suffix == ".txt":
        return []
    texts = [f"{stem}.txt" for stem in ("cameras", "images", "points3D")]
    return [name for name in texts if (model / name).is_file()]


@lru_cache(maxsize=16)
def _image_names(file: Path, mtime_ns: int, size: int) -> tuple[str, ...] | None:
    """The names in a model's file of images with this state; None if it is damaged."""
    try:
        return tuple(format_of(file).image_names(file))
    except UserError:
        return None


def _declared_images(file: Path) -> int:
    """The number of images according to the header of a model's file of images; 0 if it has
    none."""
    with file.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if file.suffix == ".bin":
        return int(struct.unpack("<Q", head[:8])[0]) if len(head) >= 8 else 0
    found = _COUNT.search(head.decode(errors="replace"))
    return int(found[1]) if found is not None else 0
