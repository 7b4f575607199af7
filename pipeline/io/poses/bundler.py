"""Bundler: ``bundle.out`` with ``list.txt``.

World to camera with OpenGL axes, a focal length in pixels, k1 and k2 about the image centre. A
focal length of zero marks an image without a pose. Source: Bundler's user's manual, "Output
format". Its points are not read: they are triangulated again.
"""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path

import numpy as np

from pipeline.io.poses.files import malformed, numbers, read_text
from pipeline.io.poses.frames import FLIP_YZ, PosedFrame, make_frame
from pipeline.io.poses.lenses import Brown, scaled_lens
from pipeline.runtime.text import shown

_FILES = ("bundle.out", "bundle/bundle.out")
# "images/a b.jpg 0 1234.5": the name may hold spaces, the focal length of EXIF may be missing.
_ENTRY = re.compile(r"^(.*?)(?:\s+0\s+[\d.eE+-]+)?\s*$")
_MAX_CAMERAS = 1_000_000


def find(folder: Path) -> str | None:
    return next((name for name in _FILES if len(files(folder / name)) == 2), None)


def files(path: Path) -> list[Path]:
    """``bundle.out`` and the list of its images, beside it or one folder up."""
    lists = [path.parent / "list.txt"]
    if path.parent.name == "bundle":
        lists.append(path.parent.parent / "list.txt")
    return [file for file in (path, *lists) if file.is_file()][:2]


def frames(path: Path) -> list[PosedFrame]:
    """The images that have a pose.

    Raises:
        UserError: Files are malformed, or lists differ in length.
    """
    _, listing = files(path)
    names = [_ENTRY.sub(r"\1", line) for line in read_text(listing).splitlines() if line.strip()]
    lines = [
        line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")
    ]
    count = numbers(path, "the first line", lines[0] if lines else "", 2)[0]
    if not 0 < count <= _MAX_CAMERAS or len(lines) < 1 + 5 * count:
        raise malformed(path, f"expected five lines for each of {count:g} cameras, found fewer")
    if len(names) != count:
        raise malformed(
            listing, f"expected as many names as cameras, found {len(names)} and {count:g}"
        )
    found = []
    for i, name in enumerate(islice(names, int(count))):
        focal, *rest = lines[1 + 5 * i : 6 + 5 * i]
        where = f"camera {i} ({shown(name)})"
        f, k1, k2 = numbers(path, where, focal, 3).tolist()
        if f == 0:
            continue
        rows = np.stack([numbers(path, where, row, 3) for row in rest])
        lens = scaled_lens(path, where, Brown(f, f, 0.0, 0.0, k=(k1, k2)), lambda *size: 1.0)
        with np.errstate(all="ignore"):
            centre = -rows[:3].T @ rows[3]
        found.append(make_frame(path, name, lens, FLIP_YZ @ rows[:3], centre, where))
    if not found:
        raise malformed(path, "expected an image with a pose, found none")
    return found
