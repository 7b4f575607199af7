"""The inventory of a scene folder: every file is used, or named with the reason why not."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pipeline.io.clouds.files import CLOUD_SUFFIXES
from pipeline.io.companions import DEPTHS, MASKS, CompanionKind
from pipeline.io.folders import PREVIEW_FOLDERS, PhotoFolder
from pipeline.io.names import (
    PHOTO_SUFFIXES,
    UNREAD_SUFFIXES,
    VIDEO_SUFFIXES,
    first_names,
    suffix_of,
)
from pipeline.io.posefiles import GivenPoses, other_pose_files
from pipeline.io.poses.kinds import POSE_LABELS
from pipeline.io.walk import TooManyFilesError, walk
from pipeline.runtime.layout import guide
from pipeline.runtime.text import is_plain

# These files are not for reconstruction (docs/guides/inputs.md): texts, side-cars and databases of
# other programs.
_TEXTS = frozenset({"readme", "license", "licence", "copying", "notice", "source", "citation"})
_SIDE_CARS = frozenset({".md", ".thm", ".lrv", ".xmp", ".aae", ".pp3", ".dop", ".db", ".ini"})
# What a synthetic scene was made from.
_SPECS = frozenset({"demo.json", "town.json"})
_COPIES = frozenset({"images", "images_2", "images_4", "images_8"})

_MODEL = re.compile(r"(cameras|images|points3d|frames|rigs)\.(bin|txt|ply)", re.IGNORECASE)
_POSITIONS = re.compile(
    r"(geo|gps|gcp|gnss|coords?|positions?|ground_?control)[^/]*\.(txt|csv|json)|"
    r".*\.(srt|gpx|kml|kmz|pos|nmea|mrk|obs|rtk)",
    re.IGNORECASE,
)
_POSES = re.compile(
    r"(transforms?|cameras?|poses?|reconstruction|calib|sfm|bundle|intrinsics?|extrinsics?)[^/]*"
    r"\.(json|xml|csv|txt|out|npy|bak|old)(\.bak|\.old|~)?",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class _Kind:
    """A kind of files that are not used.

    Attributes:
        nouns: The name of the kind in the plural.
        reason: The reason why they are not used, and what to do. "{photos}" is the folder of the
            photographs, "{poses}" the pose file.
    """

    nouns: str
    reason: str


_KINDS: Mapping[str, _Kind] = {
    "names": _Kind("files", "its name is not UTF-8 or has control characters; rename it"),
    "unread": _Kind(
        "images",
        "convert them to JPEG or PNG with their EXIF data (HEIC can be read if pillow-heif is "
        "installed)",
    ),
    "special": _Kind("pipes, sockets or devices", "expected a file; remove it"),
    "unlisted": _Kind(
        "photographs",
        "{poses} lists other photographs only; add these to it, or move the pose file out of the "
        "scene folder to have all poses estimated",
    ),
    "photographs": _Kind(
        "photographs",
        "the photographs of {photos} are used (inspect.image_folder)",
    ),
    "videos": _Kind(
        "videos",
        "videos are read from the scene folder itself, the folder of the photographs and videos/",
    ),
    "masks": _Kind(
        "masks",
        "no photograph has this name, or another mask is used for it; masks belong into masks/, "
        f"named as the photographs{guide('masks')}",
    ),
    "depths": _Kind(
        "depth maps",
        "no photograph has this name, or another depth map is used for it; depth maps belong into "
        f"depths/, named as the photographs{guide('depth-maps')}",
    ),
    "models": _Kind(
        "files of COLMAP models",
        "one COLMAP model is used, the one in sparse/ with the most photographs of this scene; "
        "move the one to use to sparse/0",
    ),
    "poses": _Kind(
        "pose files",
        "no pose file has this name (such as transforms.json or cameras.xml), or {poses} comes "
        f"first{guide('given-poses')}",
    ),
    "positions": _Kind(
        "files of positions",
        f"positions are read from EXIF and gcp_list.txt; write them there{guide('georeference')}",
    ),
    "clouds": _Kind(
        "point clouds",
        "the point cloud is points.ply (or another format) or the folder points/, or name it with "
        "init.points_file",
    ),
    "other": _Kind("files", f"no input has this name and format{guide('inputs')}"),
}


@dataclass(frozen=True)
class Inventory:
    """What decides which files of a scene are used.

    Attributes:
        folder: The scene folder.
        chosen: The folder of the photographs.
        poses: The given poses, or None.
        used: The files that are used, or have a warning of their own.
        ignored: The keys of ``_KINDS`` that get no warning: the configuration leaves them out.
    """

    folder: Path
    chosen: PhotoFolder
    poses: GivenPoses | None
    used: Collection[Path]
    ignored: Collection[str] = ()

    def unused(self) -> list[str]:
        """A warning for each kind of files that are not used, with their number and first names.

        Files that are not for reconstruction have no warning: hidden ones, texts, side-cars,
        previews, reduced copies of the photographs, and the truth of a scene.

        Raises:
            OSError: The scene folder cannot be read.
        """
        # Links lead to the same folder by several paths; their files are the same.
        real: dict[str, str] = {}
        used = set()
        for file in self.used:
            parent, name = os.path.split(file)
            if parent not in real:
                real[parent] = os.path.realpath(parent)
            used.add((real[parent], name))
        poses = {Path(file) for file in other_pose_files(self.folder, self.poses)}
        notes: list[str] = []
        found: dict[str, list[str]] = {}
        try:
            for below in walk(self.folder, notes, _is_searched):
                for name in (*below.files, *below.special):
                    path = below.path / name
                    if name[0] == "." or (below.real, name) in used:
                        continue
                    kind = self._kind(path, self.folder / path in poses)
                    kind = "special" if name in below.special else kind
                    if kind is not None and kind not in self.ignored:
                        found.setdefault(kind, []).append(_printable(path.as_posix()))
        except TooManyFilesError as error:
            notes.append(f"{error.file}: not all files were looked at: {error.what}; {error.fix}")
        lines = [self._line(kind, names) for kind in _KINDS if (names := found.get(kind))]
        return [*_shortened(notes), *lines]

    def _line(self, kind: str, names: list[str]) -> str:
        """The warning for the files of a kind."""
        path = self.chosen.path
        photos = "the scene folder itself" if path == "." else f"{path}/"
        poses = "another file" if self.poses is None else self.poses.source
        if self.poses is not None and poses == ".":  # There are several pose files.
            poses = f"the set of {POSE_LABELS[self.poses.kind]}"
        reason = _KINDS[kind].reason.replace("{photos}", photos).replace("{poses}", poses)
        if kind == "unread":
            kinds = ", ".join(sorted({suffix_of(name)[1:].upper() for name in names}))
            return f"{len(names)} {kinds} images are not used ({_first(names)}): {reason}"
        if len(names) == 1:
            return f"{names[0]} is not used: {reason}"
        return f"{len(names)} {_KINDS[kind].nouns} are not used ({_first(names)}): {reason}"

    def _kind(self, path: PurePosixPath, is_pose_file: bool) -> str | None:
        """The kind of a file that is not used; None if it is not for reconstruction."""
        name, suffix = path.name, suffix_of(path.name)
        if not is_plain(path.as_posix()):
            return "names"
        if is_pose_file:
            return "poses"
        if path.as_posix() in _SPECS or path.parts[0] == "withheld":
            return None
        if path.parts[0] == "depth_gt" and suffix in DEPTHS.suffixes:
            return None
        if _MODEL.fullmatch(name):
            own = self.poses is not None and path.parent.as_posix() == self.poses.path
            return None if own or path.parent.name == "sparse_gt" else "models"
        if path.stem.casefold() in _TEXTS or name.casefold() in _TEXTS or suffix in _SIDE_CARS:
            return None
        if suffix in UNREAD_SUFFIXES:
            return "unread"
        if suffix in VIDEO_SUFFIXES:
            return "videos"
        for key, kind in (("masks", MASKS), ("depths", DEPTHS)):
            if suffix in kind.suffixes and _is_companion(kind, path):
                return key
        if suffix in PHOTO_SUFFIXES:
            return self._kind_of_photograph(path)
        if suffix in CLOUD_SUFFIXES and (suffix != ".csv" or path.stem.casefold() == "points"):
            return "clouds"
        if _POSITIONS.fullmatch(name):
            return "positions"
        return "poses" if _POSES.fullmatch(name) else "other"

    def _kind_of_photograph(self, path: PurePosixPath) -> str | None:
        if self.chosen.base == "images" and path.parts[0] in _COPIES - {self.chosen.path}:
            return None  # The reason for the choice of the folder names the others.
        inside = self.chosen.path == "." or path.is_relative_to(self.chosen.path)
        listed = self.poses is not None and self.poses.format.names == "scene"
        return "unlisted" if inside and listed else "photographs"


def _is_searched(name: str) -> bool:
    return name[0] != "." and name.casefold() not in PREVIEW_FOLDERS


def _is_companion(kind: CompanionKind, path: PurePosixPath) -> bool:
    """Whether a file's folder or name says that it is a mask or depth map."""
    words = tuple(kind.folders)
    folders = (part.casefold() for part in path.parent.parts)
    if kind is MASKS and any(part.startswith("segment") for part in path.parent.parts):
        return True
    return any(part.startswith(words) for part in folders) or (
        kind.photograph_in(path.name) is not None
    )


def _first(names: list[str]) -> str:
    return f"first: {first_names(names, 5)}"


def _printable(name: str) -> str:
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)


def _shortened(notes: Iterable[str]) -> list[str]:
    lines = [_printable(note) for note in notes]
    return lines if len(lines) <= 3 else [*lines[:3], f"and {len(lines) - 3} further folders"]
