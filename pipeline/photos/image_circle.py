"""The image circle of a fisheye lens that does not fill the sensor: every photograph is black
beyond it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from pipeline.geometry.cameras import Camera
from pipeline.photos.load import load_rgb, to_8bit
from pipeline.scene.manifest import Photo

# The circle is found in the brightest values over an even sample of photographs, at a reduced size.
MAX_PHOTOS, LONG_SIDE = 12, 512
# Darker 8-bit values are black.
BLACK = 20
# A ring is black if at most this share of it is brighter; the ring inside the circle must be bright
# in most places, because otherwise the photographs are just dark.
BLACK_SHARE, BRIGHT_SHARE = 0.02, 0.5
# The width of the rim, which is blurred and has colour fringes.
RIM = 0.01
# A circle farther out than this share of the farthest corner hides nothing of note.
CORNER = 0.97


def image_circle(camera: Camera, photos: Sequence[Photo]) -> float:
    """The radius in pixels of the photographs of the circle around the principal point; infinity if
    there is none.

    Args:
        camera: The camera at the photographs' size.

    Raises:
        UserError: A photograph cannot be read, or changed since it was inspected.
    """
    reduction = min(1.0, LONG_SIDE / max(camera.width, camera.height))
    size = (max(1, round(camera.width * reduction)), max(1, round(camera.height * reduction)))
    brightest = np.zeros(size[::-1], np.uint8)
    for photo in photos[:: -(-len(photos) // MAX_PHOTOS)]:
        picture = to_8bit(load_rgb(photo.path, photo.digest)).max(axis=2)
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        brightest = np.maximum(brightest, small)
    cx, cy = camera.resized(*size).pinhole[2:]
    x, y = np.meshgrid(np.arange(size[0]) + 0.5 - cx, np.arange(size[1]) + 0.5 - cy)
    ring = np.hypot(x, y).astype(np.intp).ravel()
    total = np.bincount(ring)
    share = np.bincount(ring, brightest.ravel() > BLACK) / np.maximum(total, 1)
    bright = np.flatnonzero(share > BLACK_SHARE)
    radius = int(bright[-1]) + 1 if len(bright) else 0
    inner = share[int(0.93 * radius) : int(0.98 * radius)]
    if radius > CORNER * len(total) or not len(inner) or inner.mean() < BRIGHT_SHARE:
        return float(np.inf)
    return radius * (1 - RIM) / reduction
