"""Headers of video files, without decoding: containers with several tracks, sound and covers."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.io.video_tracks import PatchedFile, choose_track
from pipeline.runtime.errors import UserError
from tests.fuzz.reader import Files, Reader, of_file
from tests.movies import Stream, jpeg, sound, video, write_avi, write_mkv, write_mov

STREAMS = [video((16, 8), 3, 99), video((48, 32), 5, 50), sound(1)]


def seeds(
    suffix: str, *writers: Callable[[Path, Sequence[Stream]], Path]
) -> Callable[[], Sequence[Files]]:
    """A file by each of the writers."""

    def make() -> Sequence[Files]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"v{suffix}"
            return [{path.name: write(path, STREAMS).read_bytes()} for write in writers]

    return make


def with_cover(path: Path, streams: Sequence[Stream]) -> Path:
    edited = [video((48, 32), 5, 50, edits=[(100, 0), (80, 48)]), *streams[2:]]
    return write_mov(path, edited, cover=jpeg((16, 16), 9), cover_first=True)


def live(path: Path, streams: Sequence[Stream]) -> Path:
    return write_mkv(path, streams, known_size=False)


def read_header(file: Path) -> object:
    """The chosen track, and what the decoder would be given of the file."""
    chosen = choose_track(file)
    if chosen.track is not None:
        assert (chosen.track.frames or 0) >= 0
        assert chosen.track.pixels >= 0 and chosen.number >= 1
    size = file.stat().st_size
    with open(file, "rb") as opened:
        assert len(PatchedFile(opened, chosen.patches).read(size + 1)) == size
    if chosen.track is None:
        raise UserError("no track was found")
    return chosen


VIDEOS: dict[str, Reader] = {
    "video-mov": Reader(seeds(".mov", write_mov, with_cover), of_file(read_header)),
    "video-mkv": Reader(seeds(".mkv", write_mkv, live), of_file(read_header)),
    "video-avi": Reader(seeds(".avi", write_avi), of_file(read_header), weight=0.5),
}
