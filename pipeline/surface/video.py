"""Encode frames to a video that browsers and players open, with the available encoder."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryFile

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.errors import UserError

Frames = Iterable[NDArray[np.uint8]]

H264 = "H.264"
VP9 = "VP9; with ffmpeg on the PATH it is H.264, which more programs play"

# The matrix and range that players assume for videos of today. A browser takes the matrix of an
# older standard if not all three tags are there.
_COLORS = (
    "scale=out_color_matrix=bt709:out_range=tv,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1"
)


def find_h264() -> str | None:
    """The path of an ffmpeg that encodes H.264; None without one."""
    program = shutil.which("ffmpeg")
    if program is None:
        return None
    command = [program, "-hide_banner", "-encoders"]
    listed = subprocess.run(command, capture_output=True, text=True, check=False)
    return program if " libx264 " in listed.stdout else None


def write_video(path: Path, frames: Frames, size: tuple[int, int], fps: int) -> str:
    """Write an MP4 file, frame by frame: the same frames give the same bytes.

    Args:
        frames: (H, W, 3) uint8 RGB.
        size: The even width and height of the frames.

    Returns:
        The encoding: ``H264`` if ffmpeg is on the PATH, else ``VP9``, by OpenCV.

    Raises:
        UserError: No encoder is available, or it fails.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    program = find_h264()
    if program is None:
        _opencv(path, frames, size, fps)
        return VP9
    _ffmpeg(program, path, frames, size, fps)
    return H264


def _ffmpeg(program: str, path: Path, frames: Frames, size: tuple[int, int], fps: int) -> None:
    # With one thread and without version strings, the bytes depend on the frames alone.
    command = [
        *(program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"),
        *("-s", f"{size[0]}x{size[1]}", "-r", str(fps), "-i", "-", "-an", "-vf", _COLORS),
        *("-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p", "-threads", "1"),
        *("-fflags", "+bitexact", "-flags:v", "+bitexact", "-movflags", "+faststart", str(path)),
    ]
    with TemporaryFile() as messages:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=messages) as encoder:
            assert encoder.stdin is not None
            try:
                for frame in frames:
                    encoder.stdin.write(np.ascontiguousarray(frame).data)
                encoder.stdin.close()
            except BrokenPipeError:
                pass  # It has ended, and its messages say why.
        messages.seek(0)
        said = messages.read().decode(errors="replace").strip()
    if encoder.returncode != 0:
        raise UserError(
            f"expected ffmpeg to encode the video, found: {said or encoder.returncode}",
            file=program,
            fix="install another ffmpeg, or leave video out of export.formats",
        )


def _opencv(path: Path, frames: Frames, size: tuple[int, int], fps: int) -> None:
    # Avoid WebM, which contains a random number: the same frames give the same bytes.
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"vp09"), fps, size)
    if not writer.isOpened():
        raise UserError(
            "no program is found that encodes videos: OpenCV was built without VP9",
            fix="install ffmpeg, or leave video out of export.formats",
        )
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
