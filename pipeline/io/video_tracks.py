"""The video tracks of a file by its header, and which of them is used.

OpenCV decodes the first video stream. That may be a preview, a thumbnail or a cover picture.
Headers of MP4 and MOV, Matroska and WebM, and AVI are read here, so that the largest track is used.
Their numbers of frames are those of the file's index; FFmpeg's may be estimates from its length.
Of MPEG transport and program streams only the number of tracks is read; the first one is used.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from pipeline.io import video_avi, video_matroska, video_mp4, video_mpeg
from pipeline.io.video_header import Header, Track

# Tracks with a smaller share of the frames of the longest are pictures or thumbnails of chapters.
FEW_FRAMES = 0.1
READERS: tuple[tuple[Callable[[bytes], bool], Callable[[BinaryIO], Header]], ...] = (
    (video_mp4.is_mp4, video_mp4.read_header),
    (video_matroska.is_matroska, video_matroska.read_header),
    (video_avi.is_avi, video_avi.read_header),
    (video_mpeg.is_mpeg, video_mpeg.read_header),
)


@dataclass(frozen=True)
class ChosenTrack:
    """The video track that is used, and what its file has besides.

    Attributes:
        track: The track; None if the header was not read.
        number: Its number among the video tracks, from 1.
        others: The other video tracks.
        alike: The number of tracks of the same size, as a camera with two lenses records them.
        truncated: Whether the file is shorter than its header says.
        patches: Offset -> the bytes that replace those of the file, so that FFmpeg's first video
            stream is this track; empty if it is.
    """

    track: Track | None = None
    number: int = 1
    others: tuple[Track, ...] = ()
    alike: int = 1
    truncated: bool = False
    patches: Mapping[int, bytes] = field(default_factory=dict)


def choose_track(path: Path) -> ChosenTrack:
    """The largest video track of a file; of equally large ones, the one with the most frames.

    Pictures and tracks with few frames are used only if there are no others. A header that is
    damaged or of another format chooses nothing: FFmpeg's first video stream is decoded.
    """
    with open(path, "rb") as file:
        start = file.read(16)
        read = next((read for known, read in READERS if known(start)), None)
        if read is None:
            return ChosenTrack()
        try:
            header = read(file)
        except (ValueError, struct.error, IndexError, OverflowError, OSError):
            return ChosenTrack()
    if not header.tracks:
        return ChosenTrack(truncated=header.truncated)
    longest = max(track.frames or 0 for track in header.tracks)
    moving = [t for t in header.tracks if t.frames is None or t.frames > FEW_FRAMES * longest]
    best = max(
        moving or header.tracks, key=lambda track: (track.pixels, track.frames or 0, -track.place)
    )
    hidden = [track for track in (*header.tracks, *header.pictures) if track.place < best.place]
    return ChosenTrack(
        track=best,
        number=1 + header.tracks.index(best),
        others=tuple(track for track in header.tracks if track is not best),
        alike=sum((t.width, t.height) == (best.width, best.height) for t in moving),
        truncated=header.truncated,
        patches={track.place: track.hidden for track in hidden},
    )


class PatchedFile(io.BufferedIOBase):
    """A file with some bytes replaced, for OpenCV, which must not get an exception.

    Attributes:
        error: The first error of reading, None if there was none.
    """

    def __init__(self, file: BinaryIO, patches: Mapping[int, bytes]):
        self._file, self._patches = file, patches
        self.error: OSError | None = None

    def read(self, size: int | None = -1, /) -> bytes:
        try:
            start = self._file.tell()
            data = self._file.read(-1 if size is None else size)
        except OSError as error:
            self.error = self.error or error
            return b""
        for place, new in self._patches.items():
            if start - len(new) < place < start + len(data):
                changed = bytearray(data)
                for at, value in enumerate(new, place - start):
                    if 0 <= at < len(changed):
                        changed[at] = value
                data = bytes(changed)
        return data

    def seek(self, offset: int, whence: int = 0, /) -> int:
        try:
            return self._file.seek(offset, whence)
        except (OSError, ValueError):
            return -1
