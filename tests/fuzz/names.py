"""Names of files: matching those of other programs with photographs, and folders of any names."""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from pathlib import Path

from pipeline.config.schema import Config
from pipeline.io.companions import KINDS, find_companions
from pipeline.io.names import compare_names, match_names
from pipeline.io.walk import walk
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from tests.fuzz.reader import Files, Reader
from tests.pictures import picture

# Longer lists and names are those of no case: a folder has to be made for each.
MAX_NAMES, MAX_NAME = 60, 255

PHOTOS = (
    *("images/left/1.jpg", "images/left/2.jpg", "images/right/1.jpg", "images/right/2.JPG"),
    *("r_0.5.png", "Köln.jpg", "Ko\u0308ln2.png", "IMG_1.jpeg", "img_1.tif"),
)
LISTED = (
    *("/home/me/left/1.jpg", "C:\\scan\\right\\1.jpg", "./left/2", "2.png", "koeln.jpg"),
    *("KÖLN.JPG", "r_0.5", "img_1", "a/b/c/d/e/f/g/h/i/1.jpg", "..", ""),
)
ENTRIES = (
    *("images/p0.jpg", "images/p1.jpg", "images/a/p2.jpg", "masks/p0.png", "masks/p1.jpg.png"),
    *("depths/p0.png", "p0_mask.png", "sparse/1/cameras.txt", "transform.json", "geo.txt"),
    *("notes.md", "video.mp4", "images/p3.heic", "points.e57.bak", "gcp_list.csv", "a -> images"),
)


def seeds_of_names() -> Sequence[Files]:
    lines = "\n".join([*LISTED, "--", *PHOTOS])
    return [{"names.txt": lines.encode()}]


def match(folder: Path) -> object:
    """Each photograph and each listed name belongs to one of the others at most."""
    lines = (folder / "names.txt").read_bytes().decode(errors="replace").split("\n")
    at = lines.index("--") if "--" in lines else len(lines) // 2
    listed, photos = lines[:at], lines[at + 1 :]
    found = compare_names(listed, photos)
    alone = compare_names(listed, photos, same_positions=False)
    assert found.names.keys() <= set(photos) and set(found.names.values()) <= set(listed)
    assert len(set(alone.names.values())) == len(alone.names)
    for ambiguity in found.ambiguous:
        assert len(ambiguity.text) < 1000
    return match_names(listed, photos, folder / "names.txt")


def seeds_of_folders() -> Sequence[Files]:
    return [{"entries.txt": "\n".join(ENTRIES).encode()}]


def made(root: Path, lines: Sequence[bytes]) -> None:
    """Make the files that the lines name below ``root``; "a -> b" is a link."""
    source = root.parent / "one.png"
    if not source.exists():
        picture(source, (16, 12), mode="L")
    for line in lines[:MAX_NAMES]:
        name, arrow, target = line.partition(b" -> ")
        parts = [part[:MAX_NAME] for part in name.replace(b"\0", b"").split(b"/")]
        parts = [part for part in parts if part not in (b"", b".", b"..")][:50]
        if not parts:
            continue
        path = os.path.join(os.fsencode(root), *parts)
        try:
            os.makedirs(os.path.dirname(path), exist_ok=True)
            if arrow:
                os.symlink(target.replace(b"\0", b"").strip(b"/") or b"..", path)
            elif path.endswith((b".jpg", b".png", b".jpeg", b".heic")):
                os.link(source, path)
            else:
                open(path, "xb").close()
        except OSError:  # The name is too long, or another file has it.
            continue


def look(folder: Path) -> object:
    """The plan's view of a folder that has these names in it."""
    lines = (folder / "entries.txt").read_bytes().split(b"\n")
    root = folder.parent / "scene"
    _remove(root)
    root.mkdir()
    made(root, lines)
    notes: list[str] = []
    try:
        files = [name for below in walk(root, notes) for name in below.all_names()]
        assert len(files) == len(set(files))
        photos = [name.removeprefix("images/") for name in files if name.startswith("images/")]
        for kind in KINDS:
            find_companions(kind, root, kind.folders, photos)
        found = scan(root, "scene", Config(), cache=None)
    except OSError as error:
        raise UserError(str(error)) from None
    warnings = [*found.manifest.warnings, *found.unused]
    assert all(len(line) < 2000 and line.isprintable() for line in warnings)
    return found


def _remove(path: Path) -> None:
    """Remove a folder, including names of bytes that are not UTF-8."""
    if not path.exists():
        return
    for entry in os.scandir(os.fsencode(path)):
        if stat.S_ISDIR(entry.stat(follow_symlinks=False).st_mode):
            _remove(Path(os.fsdecode(entry.path)))
        else:
            os.unlink(entry.path)
    os.rmdir(path)


FOLDERS: dict[str, Reader] = {
    "names": Reader(seeds_of_names, match),
    "folders": Reader(seeds_of_folders, look, weight=0.1),
}
