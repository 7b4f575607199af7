"""Finding photographs and videos in folders."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from pipeline.io.names import PHOTO_SUFFIXES, VIDEO_SUFFIXES, suffix_of
from pipeline.io.walk import walk
from pipeline.runtime.text import is_plain

# Folders of a scene with images that are not photographs.
_COMPANION_FOLDER = re.compile(
    r"(masks?|depths?)([ _-].*)?|depth_?maps?|"
    r"(normals?|segmentations?|semantics?|confidence|sparse|sparse_gt|colmap|stereo)(_\d+)?"
)
# Folders of previews that cameras, network drives and archives add.
PREVIEW_FOLDERS = frozenset({"thumbs", "thumbnails", "previews", "@eadir", "__macosx"})


@dataclass(frozen=True)
class PhotoFolder:
    """A folder of photographs in a scene.

    Attributes:
        path: The folder's path relative to the scene folder; "." for the scene folder itself.
        base: The folder that the given poses refer to: that of the full-size photographs.
        reason: The reason why this folder was chosen.
        names: The sorted names of its photographs, relative to the folder.
        masks: Name -> the mask file that the pose file lists, relative to the scene folder.
        depths: Name -> the depth map that the pose file lists, relative to the scene folder.
    """

    path: str
    base: str
    reason: str
    names: list[str]
    masks: dict[str, str] = field(default_factory=dict)
    depths: dict[str, str] = field(default_factory=dict)


def pictures_in(folder: Path, *, recursive: bool = True) -> list[str]:
    """Names of the files with a photograph's suffix, relative to ``folder``, sorted.

    Hidden files and folders, names that are not UTF-8, and subfolders of previews, masks, depth
    maps and models are ignored.

    Raises:
        OSError: ``folder`` cannot be read.
        TooManyFilesError: See ``walk``.
    """
    return _files_in(folder, recursive, lambda name: suffix_of(name) in PHOTO_SUFFIXES)


def videos_in(folder: Path, *, recursive: bool = True) -> list[str]:
    """Names of the files with a video's suffix; otherwise as ``pictures_in``."""
    return _files_in(folder, recursive, lambda name: suffix_of(name) in VIDEO_SUFFIXES)


def _files_in(folder: Path, recursive: bool, wanted: Callable[[str], bool]) -> list[str]:
    # Readers refuse pipes and devices by name. The scene's inventory has the notes, too.
    notes: list[str] = []
    return sorted(
        name
        for found in walk(folder, notes, lambda name: recursive and may_hold_photographs(name))
        for name in found.all_names()
        if PurePosixPath(name).name[0] != "." and wanted(name) and is_plain(name)
    )


def relative_folders(folder: Path) -> list[str]:
    """Names of the folder's subfolders that may hold photographs, sorted."""
    return sorted(
        path.name for path in folder.iterdir() if path.is_dir() and may_hold_photographs(path.name)
    )


def may_hold_photographs(name: str) -> bool:
    """Whether a folder of this name is none of previews, masks, depth maps and models, and not
    hidden."""
    plain = name.casefold()
    return (
        name[0] != "." and plain not in PREVIEW_FOLDERS and not _COMPANION_FOLDER.fullmatch(plain)
    )
