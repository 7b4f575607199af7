"""Reading video files with OpenCV's FFmpeg: header facts, and frames one after the other.

FFmpeg converts HDR video (PQ and HLG) to standard dynamic range when OpenCV asks for 8-bit BGR.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

from pipeline.io.photofile import check_size
from pipeline.io.recorded import digest_of
from pipeline.io.video_tracks import ChosenTrack, PatchedFile, choose_track
from pipeline.runtime.errors import UserError

if TYPE_CHECKING:
    import cv2

# Read by OpenCV when it opens a file. FFmpeg recognises files by their content and would follow a
# playlist of that suffix to other files or the network; its messages do not name the file.
os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
# OpenCV takes a video for ended after 4096 packets of sound without a frame, or 64 frames that
# cannot be decoded. The file's own end is the limit.
os.environ.setdefault("OPENCV_FFMPEG_READ_ATTEMPTS", str(2**31 - 1))
os.environ.setdefault("OPENCV_FFMPEG_DECODE_ATTEMPTS", str(2**31 - 1))
# Milliseconds for opening a file and for reading a frame: OpenCV's 30 s are too few for a large
# file on a slow network.
TIMEOUT_MS = 600_000

FIX = "convert the video to H.264 in an MP4 file, or remove it from the folder"


class VideoFacts(BaseModel):
    """Facts from the header of a video file.

    Attributes:
        digest: The hex digest of the file's bytes.
        width, height: The size of a frame in pixels as it is shown, with the rotation and the
            pixel aspect ratio of the header applied.
        frames: The number of frames according to the header, 0 if it has none. It may be wrong.
        fps: The number of frames per second according to the header, 0 if it has none.
        counted: Whether ``frames`` is the number of stored frames. Otherwise it is estimated from
            the length, and pauses are no missing frames.
        truncated: Whether the file is shorter than its header says.
        others: Width and height of the video streams that are not used.
        alike: The number of streams of the same size as the one that is used, including it.
    """

    model_config = ConfigDict(frozen=True)

    digest: str
    width: int
    height: int
    frames: int
    fps: float
    counted: bool = False
    truncated: bool = False
    others: tuple[tuple[int, int], ...] = ()
    alike: int = 1


def read_video_facts(path: Path) -> VideoFacts:
    """Read a video's header.

    Raises:
        UserError: The file is not a regular file, or not a video in a supported format.
    """
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise UserError("cannot be read as a video: not a regular file", file=path, fix=FIX)
    digest = digest_of(path)
    chosen = choose_track(path)
    stored = chosen.track.frames if chosen.track is not None else None
    with _opened(path, chosen, 1) as capture:
        import cv2  # Slow to import.

        width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        frames, fps = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        aspect = _pixel_aspect(capture)
        turned = capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180 == 90
    if width <= 0 or height <= 0:
        raise UserError("cannot be read as a video: its frames have no size", file=path, fix=FIX)
    if turned:
        height = round(height * aspect)
    else:
        width = round(width * aspect)
    try:
        check_size(width, height)
    except ValueError as error:
        raise UserError(f"cannot be read as a video: {error}", file=path, fix=FIX) from None
    # The values of damaged headers may be negative, infinite or NaN.
    known = 0 < frames < 2**31
    if stored:
        known, frames = True, stored
    return VideoFacts(
        digest=digest,
        width=width,
        height=height,
        frames=int(frames) if known else 0,
        fps=float(fps) if 0 < fps < 1e6 else 0.0,
        counted=bool(stored),
        truncated=chosen.truncated,
        others=tuple((track.width, track.height) for track in chosen.others),
        alike=chosen.alike,
    )


def _pixel_aspect(capture: cv2.VideoCapture) -> float:
    """Width over height of a stored pixel; 1 if the header has none or an implausible one."""
    import cv2  # Slow to import.

    across, down = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    aspect = across / down if down > 0 else 1.0
    return aspect if 0.25 <= aspect <= 4 else 1.0


@contextmanager
def opened_video(path: Path, threads: int = 1) -> Iterator[cv2.VideoCapture]:
    """The largest video stream of a file, whose frames are rotated as the header says.

    Args:
        threads: The number of threads of the decoder.

    Raises:
        UserError: the file is not a video in a supported format, or cannot be read to its end.
    """
    with _opened(path, choose_track(path), threads) as capture:
        yield capture


@contextmanager
def _opened(path: Path, chosen: ChosenTrack, threads: int) -> Iterator[cv2.VideoCapture]:
    import cv2  # Slow to import.

    options = [cv2.CAP_PROP_N_THREADS, max(threads, 1)]
    options += [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, TIMEOUT_MS]
    options += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, TIMEOUT_MS]
    with ExitStack() as stack:
        patched = None
        if chosen.patches:
            patched = PatchedFile(stack.enter_context(open(path, "rb")), chosen.patches)
        # An absolute path, because FFmpeg takes the part before a colon for a protocol.
        source = str(path.absolute()) if patched is None else patched
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        try:
            capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, options)  # type: ignore[arg-type]
        finally:
            cv2.utils.logging.setLogLevel(level)
        stack.callback(capture.release)
        if not capture.isOpened():
            raise UserError(
                "cannot be read as a video: its format is not supported, or its header is damaged",
                file=path,
                fix=FIX,
            )
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        yield capture
        if patched is not None and patched.error is not None:
            raise patched.error
