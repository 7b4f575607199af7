"""File names of photographs and videos: supported suffixes, and the photographs that names mean."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

from pipeline.io import pillow_formats
from pipeline.io.exr import EXR_SUFFIXES
from pipeline.runtime.errors import UserError

JPEG_SUFFIXES = frozenset({".jpg", ".jpeg", ".jpe", ".jfif"})
PICTURE_SUFFIXES = JPEG_SUFFIXES | {".png", ".tif", ".tiff", ".bmp", ".webp"}
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
    pillow_formats.HEIF_SUFFIXES | {".jxl", ".jp2", ".j2k", ".gif", ".hdr", ".insp", ".psd"}
) - pillow_formats.SUFFIXES
VIDEO_SUFFIXES = frozenset(
    ".mp4 .mov .mkv .avi .m4v .webm .mts .m2ts .mpg .mpeg .3gp .3g2 .wmv .ogv".split()  # noqa: SIM905
)
PHOTO_SUFFIXES = PICTURE_SUFFIXES | LINEAR_SUFFIXES | pillow_formats.SUFFIXES
# Folders above this many parts do not tell photographs apart.
_MAX_TAIL = 8


def suffix_of(name: str) -> str:
    """The name's suffix in lower case, with the dot."""
    return PurePosixPath(name).suffix.lower()


def is_inside(name: str) -> bool:
    """Whether a name in a file of the user is a path below the folder that it is relative to."""
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts and "\0" not in name


def stem_key(name: str) -> str:
    """The name without a leading "./" and a photograph's suffix, in lower case and in Unicode's
    normal form C.

    Only photographs' suffixes are removed: "./train/r_0.5" and "train/R_0.5.png" are equal.
    """
    return _folded(_stem(name))


def _plain(name: str) -> str:
    """``name`` in Unicode's normal form C: macOS stores "é" as two characters."""
    return unicodedata.normalize("NFC", PurePosixPath(name).as_posix())


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", _plain(name).casefold())


def _stem(name: str) -> str:
    path = PurePosixPath(name)
    stem = path.with_suffix("") if path.suffix.lower() in PHOTO_SUFFIXES else path
    return _plain(stem.as_posix())


_RULES: tuple[Callable[[str], str], ...] = (str, _plain, _folded, _stem, stem_key)
"""Keys of complete names, the strictest first."""


def _parts(name: str) -> list[str]:
    """The parts of ``stem_key``, without a drive or leading "/" and ".."."""
    parts = stem_key(name).split("/")
    if re.fullmatch(r"[a-z]:", parts[0]):
        parts = parts[1:]
    return [part for part in parts if part not in ("", "..", ".")]


def _tail(parts: Sequence[str], length: int) -> str:
    return "/".join(parts[-length:])


class NameIndex:
    """Finds photographs by names that other programs and users write.

    A name means the photographs that it equals by the first of these rules that has any:

    1. the name itself;
    2. in Unicode's normal form C: macOS and others store the same name in different forms;
    3. in any case;
    4. without a photograph's suffix, in the same case, then in any case;
    5. one of the two names ends with the other, whole folders compared ("/home/me/left/1.jpg" and
       "left/1.jpg");
    6. both end with the same parts, as many as possible, down to the file name ("old/1.jpg" and
       "new/1.jpg"), unless the folder in the name is that of other photographs.

    Backslashes separate folders, if the name is no photograph's.
    """

    def __init__(self, names: Iterable[str]):
        self._names = sorted(set(names))
        self._by_key: list[dict[str, list[str]]] = [{} for _ in _RULES]
        for name in self._names:
            for rule, found in zip(_RULES, self._by_key, strict=True):
                found.setdefault(rule(name), []).append(name)

    @cached_property
    def _by_tail(self) -> dict[str, list[str]]:
        """The last parts of names, up to ``_MAX_TAIL``, -> names."""
        found: dict[str, list[str]] = {}
        for name in self._names:
            parts = _parts(name)
            for length in range(1, min(len(parts), _MAX_TAIL) + 1):
                found.setdefault(_tail(parts, length), []).append(name)
        return found

    @cached_property
    def _by_parts(self) -> dict[str, list[str]]:
        """All parts of names -> names."""
        found: dict[str, list[str]] = {}
        for name in self._names:
            found.setdefault("/".join(_parts(name)), []).append(name)
        return found

    @cached_property
    def _folders(self) -> set[tuple[int, str]]:
        """Distance from the end and part of all folders in the names."""
        return {
            (i, part)
            for name in self._names
            for i, part in enumerate(reversed(_parts(name)[-_MAX_TAIL:]))
            if i
        }

    def find(self, name: str) -> str | None:
        """The photograph that the name means; None if there is none or more than one."""
        found = self.candidates(name)
        return found[0] if len(found) == 1 else None

    def candidates(self, name: str) -> list[str]:
        """All photographs that the name may mean, by the best rule that has any, sorted."""
        return self.equal(name)[1] or self.same_tail(name)

    def equal(self, name: str) -> tuple[int, list[str]]:
        """Number of the best of the rules for complete names (1 to 4), and its photographs."""
        if "\\" in name and name not in self._by_key[0]:
            name = name.replace("\\", "/")
        for i, (rule, found) in enumerate(zip(_RULES, self._by_key, strict=True)):
            if photos := found.get(rule(name)):
                return i, photos
        return len(_RULES), []

    def same_tail(self, name: str) -> list[str]:
        """The photographs by the rules for the last parts of names (5 and 6)."""
        parts = _parts(name.replace("\\", "/"))
        for length in range(min(len(parts), _MAX_TAIL), 0, -1):
            found = self._by_tail.get(_tail(parts, length), [])
            if length < len(parts):
                whole = self._by_parts.get(_tail(parts, length), [])
                known = (length, parts[-length - 1]) in self._folders
                found = whole or ([] if known else found)
            if found:
                return found
        return []


@dataclass(frozen=True)
class Ambiguity:
    """Names in a file and photographs, of which one of either is too many.

    Attributes:
        listed: The names in the file; the same name twice if the file lists it twice.
        photos: The photographs that they may mean.
    """

    listed: tuple[str, ...]
    photos: tuple[str, ...]

    @property
    def text(self) -> str:
        if len(self.listed) == 1:
            return (
                f"{first_names(self.listed)} may mean {len(self.photos)} photographs: "
                f"{first_names(self.photos)}"
            )
        if len(set(self.listed)) == 1:
            return f"{first_names(self.listed[:1])} is listed {len(self.listed)} times"
        return f"{len(self.listed)} names may mean {self.photos[0]}: {first_names(self.listed)}"


def first_names(names: Sequence[str], count: int = 3) -> str:
    """The first names and the number of the others, in words."""
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return (
        ", ".join(name if len(name) < 100 else f"{name[:97]}..." for name in names[:count]) + more
    )


@dataclass(frozen=True)
class Matches:
    """Photographs and their names in a file.

    Attributes:
        names: Photograph -> its name in the file.
        ambiguous: The names of which it is unknown what they mean; they are not in ``names``.
    """

    names: dict[str, str]
    ambiguous: tuple[Ambiguity, ...] = ()


def compare_names(
    listed: Sequence[str], photos: Iterable[str], *, same_positions: bool = True
) -> Matches:
    """Match the names of a file with photographs; each name and photograph belongs to one.

    The names are those of ``NameIndex``; better rules come first. The last parts of names are
    compared only if no complete name is a photograph's: then the folders are another program's.

    The same name of photographs in several folders is not ambiguous if the file names no folders,
    lists each name once, and all folders hold the same names: pictures taken from the same
    positions.

    Args:
        listed: The names in the file.
        photos: The photographs' names.
        same_positions: Whether names may be those of photographs in several folders.
    """
    index = NameIndex(photos)
    equal = {name: index.equal(name) for name in listed}
    if any(found for _, found in equal.values()):
        return _matched(listed, equal)
    tails = {name: found for name in listed if (found := index.same_tail(name))}
    several = _same_positions(listed, tails) if same_positions else {}
    if several:
        return Matches(several)
    return _matched(listed, {name: (0, found) for name, found in tails.items()})


def _matched(listed: Sequence[str], found: Mapping[str, tuple[int, list[str]]]) -> Matches:
    """The matches by the number of the rule and the photographs of each name."""
    names: dict[str, str] = {}
    ambiguous: list[Ambiguity] = []
    count = Counter(listed)
    for rule in range(len(_RULES)):
        claims: dict[str, list[str]] = {}
        for name in (name for name, (number, _) in found.items() if number == rule):
            photos = [photo for photo in found[name][1] if photo not in names]
            if len(photos) > 1:
                ambiguous.append(Ambiguity((name,), tuple(photos)))
            elif photos:
                claims.setdefault(photos[0], []).extend([name] * count[name])
        for photo, of_photo in claims.items():
            if len(of_photo) > 1:
                ambiguous.append(Ambiguity(tuple(sorted(of_photo)), (photo,)))
            else:
                names[photo] = of_photo[0]
    return Matches(names, tuple(ambiguous))


def _same_positions(listed: Sequence[str], found: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Photograph -> listed name, for photographs of equal names in several folders, if these were
    taken from the same positions; otherwise empty."""
    folders = {PurePosixPath(name.replace("\\", "/")).parent for name in listed}
    if len(folders) > 1 or len({stem_key(name) for name in listed}) < len(listed):
        return {}
    held: dict[str, list[str]] = {}
    for name, photos in found.items():
        for photo in photos:
            held.setdefault(PurePosixPath(photo).parent.as_posix(), []).append(name)
    if len(held) < 2 or len({tuple(names) for names in held.values()}) > 1:
        return {}
    if any(len(names) > len(set(names)) for names in held.values()):
        return {}
    return {photo: name for name, photos in found.items() for photo in photos}


def match_names(listed: Sequence[str], photos: Iterable[str], file: str | Path) -> dict[str, str]:
    """Photograph -> its name in the pose file ``file``; see ``compare_names``.

    Raises:
        UserError: a name that may mean several photographs, several names that may mean the same
            photograph, or a name that is listed twice.
    """
    matches = compare_names(listed, photos)
    if matches.ambiguous:
        first, *others = matches.ambiguous
        more = f" (and {len(others)} more)" if others else ""
        raise UserError(
            f"expected one pose for each photograph: {first.text}{more}",
            file=file,
            fix="write names with their folders into the file and keep one photograph and one pose "
            "of each name, or set poses: ignore",
        )
    return matches.names
