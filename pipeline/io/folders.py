"""Finding photographs and videos in folders, and their masks and depth maps."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from pipeline.io.names import (
    PHOTO_SUFFIXES,
    PICTURE_SUFFIXES,
    UNREAD_SUFFIXES,
    VIDEO_SUFFIXES,
    suffix_of,
)
from pipeline.runtime.text import is_plain

# Folders of a scene with images that are not photographs, also with a suffix such as "_2".
COMPANION_FOLDERS = frozenset({"masks", "depths", "sparse", "sparse_gt", "colmap", "stereo"})
# Folders of previews that cameras, network drives and archives add.
PREVIEW_FOLDERS = frozenset({"thumbs", "thumbnails", "previews", "@eadir", "__macosx"})
_DEPTH_SUFFIXES = PICTURE_SUFFIXES | {".npy", ".npz", ".exr", ".pfm"}


@dataclass(frozen=True)
class PhotoFolder:
    """A folder of photographs in a scene.

    Attributes:
        path: relative to the scene folder, "." for itself.
        base: the folder that the given poses refer to: that of the full-size photographs.
        reason: why this folder was chosen.
        names: its photographs, relative to it, sorted.
        masks: name -> mask file listed in the pose file, relative to the scene folder.
    """

    path: str
    base: str
    reason: str
    names: list[str]
    masks: dict[str, str] = field(default_factory=dict)


def pictures_in(
    scene: Path, path: str, warnings: list[str], *, recursive: bool = True
) -> list[str]:
    """Names of the files with a photograph's suffix, relative to ``path``, sorted.

    Hidden files and folders, and subfolders of previews, masks, depth maps and models, are
    ignored. Images in formats that cannot be read add one warning.

    Args:
        scene: the scene folder.
        path: a folder, relative to ``scene``.
        warnings: warnings are added to this list; they name files relative to ``scene``.
    """
    names: list[str] = []
    unread: list[str] = []
    for where, name in _files_in(scene / path, recursive, warnings):
        full = (Path(path) / where / name).as_posix()
        if not is_plain(full):
            shown = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in full)
            warnings.append(
                f"{shown} is not used: its name is not UTF-8 or has control characters; rename it"
            )
            continue
        suffix = suffix_of(name)
        if name[0] != "." and suffix in PHOTO_SUFFIXES:
            names.append((where / name).as_posix())
        elif suffix in UNREAD_SUFFIXES:
            unread.append((Path(path) / where / name).as_posix())
    if unread:
        kinds = ", ".join(sorted({suffix_of(name)[1:].upper() for name in unread}))
        warnings.append(
            f"{len(unread)} {kinds} images are not used (first: {min(unread)}): "
            "convert them to JPEG or PNG with their EXIF data (HEIC can be read if pillow-heif is "
            "installed)"
        )
    return sorted(names)


def videos_in(folder: Path, *, recursive: bool = True) -> list[str]:
    """Names of the files with a video's suffix, relative to ``folder``, sorted.

    The same folders as of ``pictures_in`` are searched. Names that are not UTF-8 are ignored.
    """
    return sorted(
        (where / name).as_posix()
        for where, name in _files_in(folder, recursive, [])
        if name[0] != "." and suffix_of(name) in VIDEO_SUFFIXES and is_plain(str(where / name))
    )


def _files_in(folder: Path, recursive: bool, warnings: list[str]) -> Iterator[tuple[Path, str]]:
    """Folder relative to ``folder``, and name of each file; not in hidden and companion folders.

    A subfolder that cannot be read adds a warning.

    Raises:
        OSError: ``folder`` itself cannot be read.
    """

    def failed(error: OSError) -> None:
        if Path(error.filename) == folder:
            raise error
        name = Path(error.filename).relative_to(folder).as_posix()
        warnings.append(f"{name}/ is not used: it cannot be read: {error.strerror}")

    seen: set[str] = set()
    for where, subfolders, files in os.walk(folder, onerror=failed, followlinks=True):
        real = os.path.realpath(where)
        subfolders[:] = [
            name
            for name in sorted(subfolders)
            if recursive and real not in seen and name[0] != "." and not _is_companion(name)
        ]
        if real in seen:  # A symbolic link to a folder that was visited.
            continue
        seen.add(real)
        for name in files:
            yield Path(where).relative_to(folder), name


def relative_folders(folder: Path) -> list[str]:
    """Names of the folder's subfolders that may hold photographs, sorted."""
    return sorted(
        path.name
        for path in folder.iterdir()
        if path.is_dir() and path.name[0] != "." and not _is_companion(path.name)
    )


def companions(folder: Path, candidates: Sequence[str], names: Sequence[str]) -> dict[str, Path]:
    """Photograph -> its mask or depth map, from the first folder of ``candidates`` that exists.

    The file of ``a/b.jpg`` is ``a/b.png`` (any suffix) or, as in COLMAP, ``a/b.jpg.png``.

    Raises:
        OSError: the folder or a subfolder cannot be read.
    """

    def failed(error: OSError) -> None:
        raise error

    for candidate in candidates:
        root = folder / candidate
        if not root.is_dir():
            continue
        index: dict[str, Path] = {}
        for where, _, files in os.walk(root, onerror=failed):
            for file in sorted(files):
                if file[0] != "." and suffix_of(file) in _DEPTH_SUFFIXES:
                    path = Path(where) / file
                    index.setdefault(_key(path.relative_to(root).as_posix()), path)
        found = {name: index.get(name.casefold()) or index.get(_key(name)) for name in names}
        return {name: path for name, path in found.items() if path is not None}
    return {}


def _is_companion(name: str) -> bool:
    stem, _, step = name.rpartition("_")
    plain = stem if stem and step.isdecimal() else name
    return plain.casefold() in COMPANION_FOLDERS | PREVIEW_FOLDERS


def _key(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix().casefold()
