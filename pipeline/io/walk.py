"""Walking through folders whose content and links are unknown, with limits."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pipeline.runtime.errors import UserError

# Files and folders below a folder. No scene has more; "images/all -> /" has.
MAX_ENTRIES = 200_000
_MAX_DEPTH = 40


class TooManyFilesError(UserError):
    """A folder holds more than ``MAX_ENTRIES`` files and folders."""


@dataclass(frozen=True)
class Folder:
    """The files of one folder.

    Attributes:
        path: The path relative to the folder where the walk began, which is "." itself.
        real: The absolute path without symbolic links.
        files: The sorted names of files and of links to nothing.
        special: The sorted names of pipes, sockets and devices.
    """

    path: PurePosixPath
    real: str
    files: tuple[str, ...]
    special: tuple[str, ...]

    def names(self) -> Iterator[str]:
        """The files, relative to the folder where the walk began."""
        return ((self.path / name).as_posix() for name in self.files)

    def all_names(self) -> Iterator[str]:
        """The files, pipes, sockets and devices, relative to the folder where the walk began."""
        return ((self.path / name).as_posix() for name in (*self.files, *self.special))


def walk(
    root: Path, notes: list[str], enter: Callable[[str], bool] = lambda name: True
) -> Iterator[Folder]:
    """The folders below ``root`` and itself, sorted; each is visited once.

    Links to folders are followed, except to folders that contain ``root``.

    Args:
        notes: A line is added for each folder that is not visited for another reason than its
            name.
        enter: Returns True for the names of subfolders to visit.

    Raises:
        OSError: ``root`` cannot be read.
        TooManyFilesError: There are more than ``MAX_ENTRIES`` files and folders.
    """
    top = os.path.realpath(root)
    seen: set[str] = set()
    count = 0
    # The last link on the way to each folder, relative to ``root``.
    stack: list[tuple[PurePosixPath, str, str]] = [(PurePosixPath("."), top, "")]
    while stack:
        path, real, link = stack.pop()
        if real in seen:
            continue
        seen.add(real)
        try:
            entries = sorted(os.scandir(real), key=lambda entry: entry.name)
        except OSError as error:
            if real == top:
                raise
            notes.append(f"{path}/ is not used: it cannot be read: {error.strerror}")
            continue
        count += len(entries)
        if count > MAX_ENTRIES:
            raise _too_many(root, link)
        files: list[str] = []
        special: list[str] = []
        below: list[os.DirEntry[str]] = []
        for entry in entries:
            if not entry.is_dir():
                is_plain_file = entry.is_file() or (
                    entry.is_symlink() and not os.path.exists(entry.path)
                )
                (files if is_plain_file else special).append(entry.name)
            elif enter(entry.name):
                below.append(entry)
        yield Folder(path, real, tuple(files), tuple(special))
        for entry in reversed(below):
            child = path / entry.name
            target = os.path.realpath(entry.path)
            if _contains(target, top):
                if target != top:
                    notes.append(
                        f"{child}/ is not used: it is a link to {target}, which contains the scene"
                    )
            elif len(child.parts) > _MAX_DEPTH:
                notes.append(f"{child}/ is not used: it is {_MAX_DEPTH} folders deep")
            else:
                stack.append((child, target, str(child) if entry.is_symlink() else link))


def _contains(folder: str, other: str) -> bool:
    return other == folder or other.startswith(folder.rstrip("/") + "/")


def _too_many(root: Path, link: str) -> TooManyFilesError:
    if link:
        return TooManyFilesError(
            f"expected at most {MAX_ENTRIES} files below, found more by this link to "
            f"{os.path.realpath(root / link)}",
            file=root / link,
            fix="let the link point to the folder of the photographs only, or remove it",
        )
    return TooManyFilesError(
        f"expected at most {MAX_ENTRIES} files and folders, found more",
        file=root,
        fix="move what is not part of the scene out of this folder",
    )
