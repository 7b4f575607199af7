"""File names of photographs and videos: supported suffixes, and names without suffix."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import PurePosixPath

from pipeline.io import pillow_formats
from pipeline.io.exr import EXR_SUFFIXES

PICTURE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})
# RAW formats that LibRaw reads.
RAW_SUFFIXES = frozenset(
    """
    .3fr .ari .arw .bay .cap .cr2 .cr3 .crw .dcr .dcs .dng .drf .eip .erf .fff .gpr .iiq .k25 .kdc
    .mdc .mef .mos .mrw .nef .nrw .orf .pef .ptx .raf .raw .rw2 .rwl .rwz .sr2 .srf .srw .x3f
    """.split()  # noqa: SIM905
)
# Photographs of linear light, which the decode stage develops.
LINEAR_SUFFIXES = RAW_SUFFIXES | EXR_SUFFIXES
# Image formats that cannot be read; they are reported in a warning.
UNREAD_SUFFIXES = (
    pillow_formats.HEIF_SUFFIXES | {".jxl", ".jp2", ".gif", ".hdr"}
) - pillow_formats.SUFFIXES
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm"})
PHOTO_SUFFIXES = PICTURE_SUFFIXES | LINEAR_SUFFIXES | pillow_formats.SUFFIXES


def suffix_of(name: str) -> str:
    """The name's suffix in lower case, with the dot."""
    return PurePosixPath(name).suffix.lower()


def stem_key(name: str) -> str:
    """The name without a leading "./" and a photograph's suffix, in lower case.

    Only photographs' suffixes are removed: "./train/r_0.5" and "train/R_0.5.png" are equal.
    """
    path = PurePosixPath(name)
    stem = path.with_suffix("") if path.suffix.lower() in PHOTO_SUFFIXES else path
    return stem.as_posix().casefold()


class NameIndex:
    """Finds a photograph by its exact name, else by its name without suffix (``stem_key``)."""

    def __init__(self, names: Iterable[str]):
        self._exact = set(names)
        self._by_stem: dict[str, str] = {}
        for name in sorted(self._exact):
            self._by_stem.setdefault(stem_key(name), name)

    def find(self, name: str) -> str | None:
        plain = PurePosixPath(name).as_posix()
        return plain if plain in self._exact else self._by_stem.get(stem_key(name))


def match_names(listed: Sequence[str], photos: Iterable[str]) -> dict[str, str]:
    """Photograph -> its name in a pose file.

    Names match as in ``NameIndex``. If none does, the folders are another program's, and the last
    parts of the paths are compared, as many as tell the listed names apart. A name without a
    folder then matches the photographs of that name in several folders if all of these folders
    hold the same names: pictures taken from the same positions.

    Args:
        listed: the names in the pose file.
        photos: the photographs' names.
    """
    names = sorted(photos)
    index = NameIndex(names)
    found: dict[str, str] = {}
    for name in listed:
        match = index.find(name)
        if match is not None:
            found.setdefault(match, name)
    depth = 4
    while not found and depth:
        found = _match_tails(listed, names, depth)
        depth -= 1
    return found


def _match_tails(listed: Sequence[str], photos: Sequence[str], depth: int) -> dict[str, str]:
    """``match_names`` by the last ``depth`` parts of the paths; empty where that is ambiguous."""

    def tail(name: str) -> str:
        return "/".join(stem_key(name.replace("\\", "/")).split("/")[-depth:])

    by_tail: dict[str, str] = {}
    for name in listed:
        if by_tail.setdefault(tail(name), name) != name:
            return {}
    found = {photo: by_tail[tail(photo)] for photo in photos if tail(photo) in by_tail}
    folders: dict[str, set[str]] = {}
    for photo in found:
        path = PurePosixPath(photo)
        folders.setdefault(path.parent.as_posix(), set()).add(tail(photo))
    several = len(found) > len(set(found.values()))
    return {} if several and len({frozenset(held) for held in folders.values()}) > 1 else found
