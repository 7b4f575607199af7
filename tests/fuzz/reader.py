"""What is fuzzed: a reader and valid files for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

Files = dict[str, bytes]


def same(data: bytes) -> bytes:
    return data


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        seeds: The names and contents of one valid set of files each; the first file is mutated.
        read: The function that reads the folder of the files; it raises what the oracle judges.
        unpack, pack: Half of the cases mutate ``unpack(content)``, and the file is ``pack`` of it:
            for formats with checksums and compression, which refuse most other mutations.
        weight: The share of a campaign's cases, relative to the others.
    """

    seeds: Callable[[], Sequence[Files]]
    read: Callable[[Path], object]
    unpack: Callable[[bytes], bytes] = same
    pack: Callable[[bytes], bytes] = same
    weight: float = 1.0


def of_file(read: Callable[[Path], object]) -> Callable[[Path], object]:
    """A reader of the only file in a folder."""

    def of_folder(folder: Path) -> object:
        (file,) = folder.iterdir()
        return read(file)

    return of_folder
