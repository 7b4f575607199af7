"""Whether a photograph is an equirectangular panorama, from its metadata.

Sources: Google's "Photo Sphere XMP Metadata" (namespace GPano); the cameras' manuals for those
that write none.
"""

from __future__ import annotations

import re
from typing import Literal

from pipeline.io.gps import XMP_VALUE

Panorama = Literal["no", "full", "partial", "maybe"]
"""``full``: 360 by 180 degrees. ``partial``: a cropped panorama. ``maybe``: only the aspect ratio
is that of a panorama."""

_PROJECTION = re.compile(rb"GPano:ProjectionType" + XMP_VALUE + rb"([A-Za-z]{1,40})")
_NUMBER = rb"([0-9]{1,9})"
# Cameras whose stitched photographs are panorama spheres of 2:1, some without GPano.
_CAMERAS = ("ricoh theta", "insta360", "gopro max", "samsung sm-c200", "samsung sm-r210", "lg-r105")
# Narrower photographs of 2:1 are rather crops or thumbnails than panoramas.
_MIN_WIDTH = 1000


def panorama_of(xmp: bytes, body: str, width: int, height: int) -> Panorama:
    """Classify a photograph.

    Args:
        xmp: The file's XMP packet, empty without one.
        body: The camera's make and model from EXIF.
        width, height: The size in pixels.
    """
    sphere = width == 2 * height
    projection = _PROJECTION.search(xmp)
    if projection is not None:
        if projection[1].lower() != b"equirectangular":
            return "no"
        return "full" if sphere and not _cropped(xmp) else "partial"
    if sphere and body.casefold().startswith(_CAMERAS):
        return "full"
    return "maybe" if sphere and width >= _MIN_WIDTH else "no"


def _cropped(xmp: bytes) -> bool:
    """Whether the stored area is smaller than the whole sphere."""
    for side in (b"Width", b"Height"):
        full = re.search(rb"GPano:FullPano" + side + rb"Pixels" + XMP_VALUE + _NUMBER, xmp)
        stored = re.search(
            rb"GPano:CroppedAreaImage" + side + rb"Pixels" + XMP_VALUE + _NUMBER, xmp
        )
        if full is not None and stored is not None and int(stored[1]) < int(full[1]):
            return True
    return False
