"""What the header of a video file reports about its tracks."""

from __future__ import annotations

from dataclasses import dataclass

# Elements that are read: as many as six hours of sound and pictures have.
MAX_ELEMENTS = 2_000_000


@dataclass(frozen=True)
class Track:
    """A video track, or a picture that FFmpeg takes for one.

    Attributes:
        width, height: The size in pixels as stored; 0 if the header does not say it.
        frames: The number of stored frames that are shown; None if the header does not say it.
        place: The offset of the bytes that declare the track, in the order of the header.
        hidden: The bytes in their place that make FFmpeg ignore the track.
    """

    width: int
    height: int
    frames: int | None
    place: int
    hidden: bytes

    @property
    def pixels(self) -> int:
        return self.width * self.height


@dataclass(frozen=True)
class Header:
    """The header of a video file.

    Attributes:
        tracks: The video tracks, in the order of FFmpeg's streams.
        pictures: The cover pictures, which FFmpeg takes for video tracks.
        truncated: Whether the file is shorter than the header says.
    """

    tracks: tuple[Track, ...]
    pictures: tuple[Track, ...] = ()
    truncated: bool = False
