"""The COLMAP models of a scene folder, of which one is used."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from pipeline.io import colmap_binary, colmap_text
from pipeline.io.colmap import has_model
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
        names = _image_names(folder / path)
        if names is None:  # A damaged file; if this model is chosen, reading it is an error.
            images = photographs = _declared_images(folder / path)
        else:
            images, photographs = len(names), sum(bool(index.candidates(n)) for n in names)
        models.append(FoundModel(path, images, photographs))
    return sorted(models, key=lambda model: (-model.photographs, -model.images))


def text_files_beside_binary(model: Path) -> list[str]:
    """The names of the text files of a model that is read from its binary files, sorted."""
    stems = ("cameras", "images", "points3D")
    if any(not (model / f"{stem}.bin").is_file() for stem in stems[:2]):
        return []
    return [f"{stem}.txt" for stem in stems if (model / f"{stem}.txt").is_file()]


def _images_file(model: Path) -> Path:
    binary = all((model / f"{stem}.bin").is_file() for stem in ("cameras", "images"))
    return model / ("images.bin" if binary else "images.txt")


def _image_names(model: Path) -> tuple[str, ...] | None:
    """The names of a model's images; None if the file is damaged."""
    file = _images_file(model)
    state = file.stat()
    return _names_in(file, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=16)
def _names_in(file: Path, mtime_ns: int, size: int) -> tuple[str, ...] | None:
    form = colmap_binary if file.suffix == ".bin" else colmap_text
    try:
        return tuple(form.image_names(file))
    except UserError:
        return None


def _declared_images(model: Path) -> int:
    """The number of images according to the header of a model's file of images; 0 if it has
    none."""
    file = _images_file(model)
    with file.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if file.suffix == ".bin":
        return int(struct.unpack("<Q", head[:8])[0]) if len(head) >= 8 else 0
    found = _COUNT.search(head.decode(errors="replace"))
    return int(found[1]) if found is not None else 0
