"""Masks and depth maps: the files that belong to a photograph by their names."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pipeline.io.names import (
    PICTURE_SUFFIXES,
    Ambiguity,
    NameIndex,
    compare_names,
    stem_key,
    suffix_of,
)
from pipeline.io.walk import walk
from pipeline.runtime.errors import UserError
from pipeline.runtime.text import is_plain


@dataclass(frozen=True)
class CompanionKind:
    """A kind of files that belong to photographs.

    Attributes:
        noun: The name of the kind in the singular.
        folders: The folders that hold them, in the order of preference.
        suffixes: The suffixes of their files.
        affix: A pattern of names with a word before or after the photograph's name. Its groups are
            the photograph's name before and after it.
        fix: The remedy, for the error message if it is unknown which photograph a file belongs to.
    """

    noun: str
    folders: tuple[str, ...]
    suffixes: frozenset[str]
    affix: re.Pattern[str]
    fix: str

    def photograph_in(self, name: str) -> str | None:
        """The photograph's name in "a_mask.png", "a.jpg.mask.png" or "mask_a.png"; None for names
        without such a word."""
        path = PurePosixPath(name)
        found = self.affix.fullmatch(path.stem)
        if found is None or suffix_of(name) not in self.suffixes:
            return None
        return path.with_name(found["after"] or found["before"]).as_posix()

    def places(self, photos: str, copy: str) -> list[str]:
        """The folders that may hold them, relative to the scene folder.

        Args:
            photos: The folder of the photographs.
            copy: The suffix of its name for reduced copies: "_4" of "images_4".
        """
        suffixes = dict.fromkeys([copy, ""])
        own = [f"{name}{suffix}" for suffix in suffixes for name in self.folders]
        parent = PurePosixPath(photos).parent
        beside = [(parent / name).as_posix() for name in self.folders] if photos != "." else []
        inside = [f"{photos}/{name}" for name in self.folders] if photos != "." else []
        return list(dict.fromkeys([*own, *beside, *inside]))


def _affix(words: str) -> re.Pattern[str]:
    return re.compile(rf"(?P<before>.+)[ _.-]{words}|{words}[ _.-](?P<after>.+)", re.IGNORECASE)


MASKS = CompanionKind(
    "mask",
    ("masks", "mask"),
    PICTURE_SUFFIXES,
    _affix("(?:dynamic[_-])?masks?"),
    "keep one file a photograph, named as it (masks/a.png or masks/a.jpg.png for images/a.jpg), or "
    "set views.masks: ignore",
)
DEPTHS = CompanionKind(
    "depth map",
    ("depths", "depth"),
    PICTURE_SUFFIXES | {".npy", ".npz", ".exr", ".pfm"},
    _affix("depth(?:[_-]?map)?"),
    "keep one file a photograph, named as it (depths/a.png for images/a.jpg)",
)
KINDS = (MASKS, DEPTHS)


def beside_photographs(kind: CompanionKind, names: Iterable[str]) -> dict[str, list[str]]:
    """Find the masks or depth maps in the photographs' own folders, as "a_mask.png" beside "a.jpg".

    Returns:
        Photograph -> its files: one, or several that are ambiguous. Two photographs that differ
        only in the suffix, as a RAW file and its JPEG, share their files.
    """
    index = NameIndex(names)
    found: dict[str, list[str]] = {}
    for name in sorted(names):
        base = kind.photograph_in(name)
        if base is None:
            continue
        photos = [p for p in index.equal(base)[1] if p != name and kind.photograph_in(p) is None]
        if len({stem_key(photo) for photo in photos}) == 1:
            for photo in photos:
                found.setdefault(photo, []).append(name)
    return found


def several_beside(
    kind: CompanionKind, root: Path, found: Mapping[str, Sequence[str]]
) -> UserError | None:
    """The error of a result of ``beside_photographs`` with several files of one photograph; None
    if there is none."""
    several = [Ambiguity(tuple(files), (photo,)) for photo, files in found.items() if files[1:]]
    if not several:
        return None
    return _ambiguous(kind, root, several, {name: [name] for a in several for name in a.listed})


def find_companions(
    kind: CompanionKind, scene: Path, places: Sequence[str], photos: Sequence[str]
) -> dict[str, Path]:
    """Find each photograph's mask or depth map in the first folder that has any.

    The file of ``a/b.jpg`` is ``a/b.png`` (any suffix), ``a/b.jpg.png`` as in COLMAP, or one with
    the word before or after the photograph's name: ``a/b_mask.png``, ``a/mask_b.png``.

    Args:
        places: The folders to search, relative to ``scene``. Case is ignored.

    Raises:
        OSError: a folder cannot be read.
        UserError: a file that may belong to several photographs, or several files of one.
    """
    for place in places:
        for root in _in_any_case(scene, place):
            notes: list[str] = []
            files = [
                name
                for folder in walk(root, notes)
                for name in folder.names()
                if PurePosixPath(name).name[0] != "."
                and suffix_of(name) in kind.suffixes
                and is_plain(name)
            ]
            found = _matched(kind, root, files, photos)
            if found:
                return {photo: root / name for photo, name in found.items()}
    return {}


def _in_any_case(scene: Path, place: str) -> list[Path]:
    """The folders at ``place``, with its own case first."""
    found = [scene]
    for part in PurePosixPath(place).parts:
        found = [
            folder / name
            for folder in found
            for name in sorted(os.listdir(folder), key=lambda name: (name != part, name))
            if name.casefold() == part.casefold() and (folder / name).is_dir()
        ]
    return found


def _matched(
    kind: CompanionKind, root: Path, files: Sequence[str], photos: Sequence[str]
) -> dict[str, str]:
    """Photograph -> file below ``root``."""
    plain = {file: PurePosixPath(file).with_suffix("").as_posix() for file in files}
    # "a.jpg.png" is of "a.jpg". A dot that is part of the name is no suffix: "r_0.5.png".
    found = _compare(kind, root, plain, photos)
    left = [photo for photo in photos if photo not in found]
    affixed = {
        file: name
        for file in files
        if file not in found.values() and (name := kind.photograph_in(file)) is not None
    }
    return found | _compare(kind, root, affixed, left)


def _compare(
    kind: CompanionKind, root: Path, named: dict[str, str], photos: Sequence[str]
) -> dict[str, str]:
    """Photograph -> file, by the photograph's name in each file's name."""
    matches = compare_names(list(named.values()), photos, same_positions=False)
    files: dict[str, list[str]] = {}
    for file, name in named.items():
        files.setdefault(name, []).append(file)
    if matches.ambiguous:
        raise _ambiguous(kind, root, matches.ambiguous, files)
    return {photo: files[name][0] for photo, name in matches.names.items()}


def _ambiguous(
    kind: CompanionKind, root: Path, found: Sequence[Ambiguity], files: dict[str, list[str]]
) -> UserError:
    first = found[0]
    of_photo = sorted(file for name in set(first.listed) for file in files[name])
    if len(first.photos) > 1:
        what = f"{of_photo[0]} may belong to {', '.join(first.photos[:3])}"
    else:
        what = f"found {len(of_photo)} for {first.photos[0]}: {', '.join(of_photo[:3])}"
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return UserError(
        f"expected one {kind.noun} for each photograph: {what}{more}", file=root, fix=kind.fix
    )
