"""Conversion of a video's decoded frames to photographs: square pixels, all rows from one time."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class FrameFormat:
    """The format in which a video's frames are stored.

    Attributes:
        size: (width, height) of a frame with square pixels.
        interlaced: Whether even and odd rows were recorded one after the other.
    """

    size: tuple[int, int]
    interlaced: bool

    def photograph(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The photograph (height, width, 3) BGR from a frame (H, W, 3) BGR as decoded."""
        if self.interlaced:
            frame = first_field(frame)
        if (frame.shape[1], frame.shape[0]) == self.size:
            return frame
        return np.asarray(cv2.resize(frame, self.size, interpolation=cv2.INTER_AREA), np.uint8)


def first_field(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The even rows of a frame, interpolated to its height."""
    height, width = frame.shape[:2]
    # Row y of the frame is row y / 2 of the field.
    halved = np.array([[1, 0, 0], [0, 0.5, 0]])
    return np.asarray(
        cv2.warpAffine(
            frame[::2],
            halved,
            (width, height),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        ),
        np.uint8,
    )


def is_combed(frame: NDArray[np.uint8]) -> bool:
    """Whether rows resemble those of their own field more than their neighbours, as the rows of
    moving things in interlaced video do."""
    rows = frame[:, ::4, 1].astype(np.int16)
    neighbours = np.abs(rows[1:] - rows[:-1]).mean()
    same_field = np.abs(rows[2:] - rows[:-2]).mean()
    return bool(neighbours > same_field)
