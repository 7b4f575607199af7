"""Detection of photographs that form a sequence."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from itertools import pairwise

from pipeline.io.names import stem_key
from pipeline.scene.manifest import Photo

# With longer intervals, consecutive photographs need not overlap.
MAX_GAP_SECONDS = 10.0
# The names of video frames: frame_0001, video-12. A number alone is no evidence, because unordered
# collections are numbered too.
_FRAME_PREFIX = re.compile(r"(frame|video|vid)[ _-]?$")


def why_ordered(photos: Sequence[Photo], num_videos: int = 0) -> str | None:
    """The reason to treat ``photos`` (sorted by name) and the frames of videos as a sequence, or
    None.

    EXIF times decide if every photograph has one, otherwise names.
    """
    if num_videos:
        if photos and why_ordered(photos) is None:
            return None
        return "frames of a video" if num_videos == 1 else f"frames of {num_videos} videos"
    if len(photos) < 3:
        return None
    moments = [datetime.fromisoformat(photo.taken) for photo in photos if photo.taken]
    if len(moments) == len(photos):
        gaps = sorted((after - before).total_seconds() for before, after in pairwise(moments))
        median = gaps[len(gaps) // 2]
        if gaps[0] >= 0 and median <= MAX_GAP_SECONDS:
            return f"EXIF times in the order of names, {median:g} s apart"
        return None
    numbered = [re.fullmatch(r"(.*?)(\d+)", stem_key(photo.name)) for photo in photos]
    matches = [match for match in numbered if match is not None]
    prefixes = {match[1] for match in matches}
    if len(matches) < len(photos) or len(prefixes) > 1:
        return None
    growing = all(int(a[2]) < int(b[2]) for a, b in pairwise(matches))
    if growing and _FRAME_PREFIX.search(prefixes.pop()):
        return "numbered like video frames"
    return None
