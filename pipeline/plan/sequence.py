"""Whether photographs, sorted by name, were taken one after another."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from itertools import pairwise

from pipeline.io.names import stem_key
from pipeline.scene.manifest import Photo

# Slower than this between photographs, neighbours in time need not overlap.
MAX_GAP_SECONDS = 10.0
# Names that programs give to the frames of a video: frame_0001, video-12. A bare number says
# nothing: collections are numbered too.
_FRAME_PREFIX = re.compile(r"(frame|video|vid)[ _-]?$")


def why_ordered(photos: Sequence[Photo]) -> str | None:
    """The reason to count ``photos`` (sorted by name) as a sequence; None where there is none.

    EXIF times decide where every photograph has one, names otherwise.
    """
    if len(photos) < 3:
        return None
    moments = [datetime.fromisoformat(photo.taken) for photo in photos if photo.taken]
    if len(moments) == len(photos):
        gaps = sorted((after - before).total_seconds() for before, after in pairwise(moments))
        median = gaps[len(gaps) // 2]
        if gaps[0] >= 0 and median <= MAX_GAP_SECONDS:
            return f"EXIF times follow the names, {median:g} s apart"
        return None
    numbered = [re.fullmatch(r"(.*?)(\d+)", stem_key(photo.name)) for photo in photos]
    matches = [match for match in numbered if match is not None]
    prefixes = {match[1] for match in matches}
    if len(matches) < len(photos) or len(prefixes) > 1:
        return None
    growing = all(int(a[2]) < int(b[2]) for a, b in pairwise(matches))
    if growing and _FRAME_PREFIX.search(prefixes.pop()):
        return "numbered like the frames of a video"
    return None
