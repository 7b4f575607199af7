"""Files that would take much time or memory if a reader trusted them end at once with one error."""

from __future__ import annotations

import pytest

from tests.fuzz.bombs import BOMBS, ENDLESS, write_endless
from tests.fuzz.campaign import judged
from tests.fuzz.readers import READERS


@pytest.mark.parametrize("name", READERS)
def test_a_bomb_ends_with_one_error(name, tmp_path):
    """It may be read, too, within the limits of time and memory."""
    reader = READERS[name]
    seeds = list(reader.seeds())
    if not seeds:
        pytest.skip(f"not run: a package that reads {name} is missing")
    for files in seeds[:1]:
        first, data = next(iter(files.items()))
        cases = {bomb: files | {first: make(reader, data)} for bomb, make in BOMBS.items()}
        found = judged(reader, cases, tmp_path / "files")
        assert {bomb: what for bomb, what in found.items() if what} == {}


# These read the bytes themselves for the function under test, or are called after a check of the
# file's kind.
READ_HERE = {"npy", "icc", "names", "folders", "video", "video-mov", "video-mkv", "video-avi"}
READ_HERE |= {"gps-xmp", "projection"}


@pytest.mark.parametrize("kind", ENDLESS)
@pytest.mark.parametrize("name", sorted(READERS.keys() - READ_HERE))
def test_a_file_without_end_ends_at_once(name, kind, tmp_path):
    """It is refused, or is not taken for a file of the format."""
    reader = READERS[name]
    for files in list(reader.seeds())[:1]:
        folder = tmp_path / "files"
        folder.mkdir()
        first, *others = files
        write_endless(folder / first, kind)
        for other in others:
            (folder / other).write_bytes(files[other])
        found = judged(reader, {kind: None}, folder)[kind]
        # Callers of some readers report an OSError with the name of the file.
        assert not found or found.startswith("OSError")
