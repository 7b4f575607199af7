"""Small videos made for tests."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

CODES = {".avi": "MJPG", ".mkv": "MJPG", ".mp4": "mp4v", ".mov": "mp4v"}


def write_video(path: Path, frames: Iterable[Image], fps: float = 25.0) -> Path:
    """Write (H, W, 3) BGR frames."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = None
    for frame in frames:
        if writer is None:
            code = cv2.VideoWriter.fourcc(*CODES[path.suffix])
            size = frame.shape[1], frame.shape[0]
            writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, size)
            assert writer.isOpened()
        writer.write(np.ascontiguousarray(frame))
    assert writer is not None
    writer.release()
    return path


def texture(seed: int = 0, size: tuple[int, int] = (900, 160)) -> Image:
    """Smooth noise of a size (width, height), in which corners can be tracked."""
    noise = np.random.default_rng(seed).random((size[1], size[0], 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.asarray(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX), np.uint8)  # type: ignore[call-overload]


def panned(positions: Iterable[int], seed: int = 0, width: int = 160) -> list[Image]:
    """Windows of a texture at these horizontal positions in pixels."""
    picture = texture(seed)
    return [picture[20:140, x : x + width] for x in positions]
