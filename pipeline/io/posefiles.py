"""Finding and summarising the camera poses that a scene folder holds."""

from __future__ import annotations

import os
from collections import Counter
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import has_model, read_model
from pipeline.io.fact_cache import FactCache
from pipeline.io.folders import PhotoFolder
from pipeline.io.llff import read_rows
from pipeline.io.names import PHOTO_SUFFIXES, NameIndex, suffix_of
from pipeline.io.recorded import digest_of
from pipeline.io.transforms import find_transforms, frame_camera_model, read_frames
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Reconstruction

_COLMAP_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
_MODEL_FILES = [(stem, end) for stem in ("cameras", "images") for end in ("bin", "txt")]
_LLFF_FILE = "poses_bounds.npy"
# A camera with fewer images determines no more than a focal length and one radial coefficient.
MIN_IMAGES_PER_CAMERA = 5


PoseKind = Literal["colmap", "transforms", "llff"]
_KINDS = {"colmap": "COLMAP model", "transforms": "transforms", "llff": "LLFF poses"}


class PoseSummary(BaseModel):
    """Summary of the poses in a scene folder."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: PoseKind = Field(description="Kind of the pose files.")
    path: str = Field(
        description="The model's folder, the json or the npy file, relative to the scene folder; "
        "`.` for several transforms files."
    )
    num_images: int = Field(description="Number of images with a pose.")
    models: tuple[str, ...] = Field(description="Camera models in use.")
    pinhole: bool = Field(description="Whether no camera has lens distortion.")
    num_points: int = Field(description="Number of sparse points.")
    tracked: int = Field(
        description="Number of observations with known pixels in the image that has the fewest."
    )
    centred: bool = Field(
        description=f"Whether a camera of {MIN_IMAGES_PER_CAMERA} or more images has its principal "
        "point exactly at the image centre, as if it had not been estimated."
    )

    @property
    def label(self) -> str:
        """Kind, place and number of the poses, in words."""
        where = "transforms*.json" if self.path == "." else self.path
        return f"{_KINDS[self.kind]} {where}, {self.num_images} cameras"


class GivenPoses(PoseSummary):
    """The poses in a scene folder.

    Attributes:
        names: photographs' names in the pose files; empty for LLFF, which goes by order.
    """

    names: tuple[str, ...]


def find_poses(folder: Path, cache: FactCache) -> GivenPoses | None:
    """The poses in a scene folder: a COLMAP model, else transforms, else LLFF; None without any.

    Raises:
        UserError: the pose files are malformed.
    """
    for path in _COLMAP_FOLDERS:
        if has_model(folder / path):
            return _summary(folder, "colmap", path, cache)
    files = find_transforms(folder)
    if files:
        path = files[0].name if len(files) == 1 else "."
        return _summary(folder, "transforms", path, cache)
    if (folder / _LLFF_FILE).is_file():
        return _summary(folder, "llff", _LLFF_FILE, cache)
    return None


def incomplete_models(folder: Path) -> list[str]:
    """A warning for each COLMAP folder that has cameras or images but not both."""
    return [
        f"{path}: not used: expected a COLMAP model with cameras and images, found only one of them"
        for path in _COLMAP_FOLDERS
        if not has_model(folder / path)
        and any((folder / path / f"{stem}.{end}").is_file() for stem, end in _MODEL_FILES)
    ]


def pose_files(path: Path) -> list[Path]:
    """The files that the poses at ``path`` (folder or file) consist of."""
    if path.is_file():
        return [path]
    for suffix in (".bin", ".txt"):
        files = [path / f"{stem}{suffix}" for stem in ("cameras", "images", "points3D")]
        if files[0].is_file() and files[1].is_file():
            return [file for file in files if file.is_file()]
    return find_transforms(path)


def truth_folder(folder: Path) -> Path | None:
    """The folder of ground truth poses, if any. They are for evaluation only, never an input."""
    truth = folder / "sparse_gt"
    return truth if has_model(truth) else None


def transforms_photos(folder: Path, warnings: list[str] | None) -> PhotoFolder | None:
    """The existing photographs that transforms*.json lists, or None if there are none.

    Args:
        warnings: None if the poses are not used; then a malformed file is no error.
    """
    if not find_transforms(folder) or (warnings is None and has_any_model(folder)):
        return None
    try:
        frames = {frame.path: frame for frame in read_frames(folder)}
    except UserError:
        if warnings is not None:
            raise
        return None
    parents = sorted({str(PurePosixPath(name).parent) for name in frames})
    existing = [
        str(PurePosixPath(parent) / name)
        for parent in parents
        if not parent.startswith(("/", "..")) and (folder / parent).is_dir()
        for name in os.listdir(folder / parent)
        if suffix_of(name) in PHOTO_SUFFIXES and name[0] != "."
    ]
    index = NameIndex(existing)
    found = {match: frame for name, frame in frames.items() if (match := index.find(name))}
    if not found:
        return None
    base = os.path.commonpath([os.path.dirname(name) or "." for name in found]) or "."
    masks = {os.path.relpath(name, base): frame.mask for name, frame in found.items()}
    return PhotoFolder(
        base,
        base,
        "the photographs that transforms*.json lists",
        sorted(masks),
        {name: mask for name, mask in masks.items() if mask is not None},
    )


def has_any_model(folder: Path) -> bool:
    return any(has_model(folder / path) for path in _COLMAP_FOLDERS)


def _summary(folder: Path, kind: str, path: str, cache: FactCache) -> GivenPoses:
    """Summarise the poses; cached by the files' digests, because large models take seconds."""
    digests = [
        [file.name, cache.get(file, "digest", partial(digest_of, file))]
        for file in pose_files(folder / path)
    ]
    read = {"colmap": _colmap, "transforms": _transforms, "llff": _llff}[kind]
    key = f"poses:{folder / path}"
    facts = cache.get_for_state(
        key, digests, lambda: {"kind": kind, "path": path, **read(folder, path)}
    )
    return GivenPoses.model_validate(facts)


def _colmap(folder: Path, path: str) -> dict[str, Any]:
    model = read_model(folder / path)
    used = [model.cameras[i] for i in sorted({im.camera_id for im in model.images.values()})]
    return {
        "names": sorted(image.name for image in model.images.values()),
        "num_images": len(model.images),
        "models": sorted({camera.model for camera in used}),
        "pinhole": all(camera.is_pinhole for camera in used),
        "num_points": len(model.points),
        "tracked": _tracked(model),
        "centred": any(_is_centred(model.cameras[i]) for i in _shared(model)),
    }


def _tracked(model: Reconstruction) -> int:
    known = ~np.isnan(model.points.track_xy[:, 0])
    seen = Counter(model.points.track_image_id[known].tolist())
    return min((seen[number] for number in model.images), default=0)


def _shared(model: Reconstruction) -> list[int]:
    """Ids of the cameras with ``MIN_IMAGES_PER_CAMERA`` images or more."""
    used = Counter(image.camera_id for image in model.images.values())
    return [number for number, count in used.items() if count >= MIN_IMAGES_PER_CAMERA]


def _is_centred(camera: Camera) -> bool:
    return not camera.is_spherical and camera.pinhole[2:] == (camera.width / 2, camera.height / 2)


def _transforms(folder: Path, path: str) -> dict[str, Any]:
    frames = read_frames(folder / path)
    models = sorted({frame_camera_model(frame) for frame in frames})
    return {
        "names": sorted(frame.path for frame in frames),
        "num_images": len(frames),
        "models": models,
        "pinhole": models == ["PINHOLE"],
        "num_points": 0,
        "tracked": 0,
        "centred": False,
    }


def _llff(folder: Path, path: str) -> dict[str, Any]:
    return {
        "names": [],
        "num_images": len(read_rows(folder / path)),
        "models": ["SIMPLE_PINHOLE"],
        "pinhole": True,
        "num_points": 0,
        "tracked": 0,
        "centred": False,
    }
