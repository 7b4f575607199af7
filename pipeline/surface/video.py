"""Encode frames to a video that browsers and players open, with the available encoder."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

Frames = Sequence[NDArray[np.uint8]]


def write_video(folder: Path, frames: Frames, fps: int) -> Path:
    """Write ``video.mp4``, in H.264 if ffmpeg is on the PATH, else in VP9 by OpenCV; without
    either, an animated ``video.webp``. Returns the file.

    Args:
        frames: (H, W, 3) uint8 RGB, all of one size with even sides.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, encode in (("mp4", _ffmpeg), ("mp4", _opencv), ("webp", _pillow)):
        path = folder / f"video.{name}"
        temporary = folder / f".video.{os.getpid()}.{name}"
        try:
            if encode(temporary, frames, fps) and temporary.stat().st_size > 0:
                os.replace(temporary, path)
                return path
        finally:
            temporary.unlink(missing_ok=True)
    raise OSError("no encoder could write the video")


def _ffmpeg(path: Path, frames: Frames, fps: int) -> bool:
    program = shutil.which("ffmpeg")
    if program is None:
        return False
    height, width = frames[0].shape[:2]
    # Use one thread and no version strings: the same frames give the same bytes.
    command = [
        *(program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"),
        *("-s", f"{width}x{height}", "-r", str(fps), "-i", "-", "-an"),
        *("-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-threads", "1"),
        *("-fflags", "+bitexact", "-flags:v", "+bitexact", "-movflags", "+faststart", str(path)),
    ]
    data = b"".join(frame.tobytes() for frame in frames)
    done = subprocess.run(command, input=data, capture_output=True, check=False)
    return done.returncode == 0 and path.exists()


def _opencv(path: Path, frames: Frames, fps: int) -> bool:
    height, width = frames[0].shape[:2]
    # Avoid WebM, which contains a random number: the same frames give the same bytes.
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"vp09"), fps, (width, height))
    if not writer.isOpened():
        return False
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    return path.exists()


def _pillow(path: Path, frames: Frames, fps: int) -> bool:
    pictures = [Image.fromarray(frame) for frame in frames]
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=1000 // fps, loop=0, quality=80
    )
    return True
