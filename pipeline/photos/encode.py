"""Writing image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray


def write_picture(path: Path, picture: NDArray[Any], options: Sequence[int] = ()) -> None:
    """Write an image in OpenCV's layout, in the format of the path's suffix, and make its folder.

    Args:
        options: The options of OpenCV's encoder.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # The image is encoded and written separately: cv2.imwrite does not report a full disk.
    _, data = cv2.imencode(path.suffix, picture, list(options))
    path.write_bytes(data.tobytes())
