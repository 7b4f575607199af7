"""The registry of the pose files that a scene folder may hold."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import model_files, read_model
from pipeline.io.colmap_models import find_models
from pipeline.io.llff import read_poses_bounds, read_rows
from pipeline.io.poses import (
    bundler,
    metashape,
    openmvg,
    opensfm,
    pix4d,
    pix4d_angles,
    polycam,
    realitycapture,
    record3d,
    scannet,
)
from pipeline.io.poses.files import first_file
from pipeline.io.poses.frames import PosedFrame, distinct_frames, reconstruct
from pipeline.io.poses.kinds import PoseKind
from pipeline.io.transforms import find_transforms, read_frames
from pipeline.scene.reconstruction import Reconstruction

_LLFF_FILE = "poses_bounds.npy"
# A camera with fewer images determines no more than a focal length and one radial coefficient.
MIN_IMAGES_PER_CAMERA = 5

Sizes = Mapping[str, tuple[int, int]]
Names = Literal["photos", "scene", "order"]


@dataclass(frozen=True)
class PoseFormat:
    """A format of pose files.

    Attributes:
        kind: The name of the format in records.
        names: What the names of images refer to. "photos": the folder of the photographs;
            "scene": the scene folder, so that the file lists the photographs; "order": the file
            has no names, its rows are the photographs sorted by name.
        find: Returns the pose file or folder in a scene folder, relative to it; None without one.
        files: Returns the files that the poses at a path consist of.
        summarise: Returns the fields of ``GivenPoses`` except ``kind`` and ``path``.
        read: Reads the poses of existing photographs; the arguments are the path, the width and
            height in pixels, and, for "order", the names of all photographs.
        frames: Reads the frames at a path; None for formats that have no names or have points.
    """

    kind: PoseKind
    names: Names
    find: Callable[[Path], str | None]
    files: Callable[[Path], list[Path]]
    summarise: Callable[[Path], dict[str, Any]]
    read: Callable[[Path, Sizes, Sequence[str]], Reconstruction]
    frames: Callable[[Path], Sequence[PosedFrame]] | None = None

    def prefix(self, base_folder: str) -> str:
        """What precedes photographs' names in the file, if they are in ``base_folder`` of the
        scene folder."""
        return f"{base_folder}/" if self.names == "scene" and base_folder != "." else ""


def of_frames(
    kind: PoseKind,
    find: Callable[[Path], str | None],
    frames: Callable[[Path], Sequence[PosedFrame]],
    *,
    names: Names = "photos",
    files: Callable[[Path], list[Path]] = lambda path: [path],
    lost: Callable[[Path], list[str]] = lambda path: [],
) -> PoseFormat:
    """A format without points, by the function that reads its frames.

    Args:
        lost: The names of photographs that the files list without a pose.
    """
    return PoseFormat(
        kind=kind,
        names=names,
        find=find,
        files=files,
        summarise=lambda path: {**_of_frames(frames(path)), "lost": lost(path)},
        read=lambda path, sizes, listed: reconstruct(frames(path), sizes, path),
        frames=frames,
    )


def _find_transforms(folder: Path) -> str | None:
    files = find_transforms(folder)
    return None if not files else files[0].name if len(files) == 1 else "."


def _transforms_files(path: Path) -> list[Path]:
    return [path] if path.is_file() else find_transforms(path)


def _of_colmap(path: Path) -> dict[str, Any]:
    model = read_model(path)
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


def _without_points(names: Sequence[str], count: int, models: Sequence[str]) -> dict[str, Any]:
    return {
        "names": sorted(names),
        "num_images": count,
        "models": list(models),
        "pinhole": set(models) <= {"PINHOLE", "SIMPLE_PINHOLE"},
        "num_points": 0,
        "tracked": 0,
        "centred": False,
    }


def _of_frames(frames: Sequence[PosedFrame]) -> dict[str, Any]:
    distinct = distinct_frames(frames)
    names = [frame.name for frame in distinct]
    models = sorted({frame.lens.model for frame in frames})
    splits = {frame.name: frame.split for frame in distinct if frame.split is not None}
    return {**_without_points(names, len(names), models), "splits": splits}


FORMATS: tuple[PoseFormat, ...] = (
    PoseFormat(
        kind="colmap",
        names="photos",
        find=lambda folder: next((model.path for model in find_models(folder)), None),
        files=model_files,
        summarise=_of_colmap,
        read=lambda path, sizes, listed: read_model(path),
    ),
    of_frames("transforms", _find_transforms, read_frames, names="scene", files=_transforms_files),
    PoseFormat(
        kind="llff",
        names="order",
        find=lambda folder: first_file(folder, [_LLFF_FILE]),
        files=lambda path: [path],
        summarise=lambda path: _without_points([], len(read_rows(path)), ["SIMPLE_PINHOLE"]),
        # Row i belongs to photograph i, so unreadable photographs count.
        read=lambda path, sizes, listed: read_poses_bounds(path, listed),
    ),
    of_frames("metashape", metashape.find, metashape.frames),
    of_frames("realitycapture_csv", realitycapture.find_csv, realitycapture.csv_frames),
    of_frames("pix4d", pix4d.find, pix4d.frames, files=pix4d.files),
    of_frames("pix4d_angles", pix4d_angles.find, pix4d_angles.frames, files=pix4d_angles.files),
    of_frames("bundler", bundler.find, bundler.frames, files=bundler.files),
    of_frames("opensfm", opensfm.find, opensfm.frames),
    of_frames("openmvg", openmvg.find, openmvg.frames),
    of_frames("polycam", polycam.find, polycam.frames, names="scene", files=polycam.files),
    of_frames("record3d", record3d.find, record3d.frames, names="scene"),
    of_frames(
        "scannet",
        scannet.find,
        scannet.frames,
        names="scene",
        files=scannet.files,
        lost=scannet.lost,
    ),
    of_frames(
        "realitycapture_xmp",
        realitycapture.find_xmp,
        realitycapture.xmp_frames,
        files=realitycapture.xmp_files,
    ),
)
"""In the order of preference."""


def format_of(kind: PoseKind) -> PoseFormat:
    return next(entry for entry in FORMATS if entry.kind == kind)
