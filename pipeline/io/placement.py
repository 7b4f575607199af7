"""Where a georeferenced scene lies on the earth, in Earth-centred coordinates (ECEF, WGS84)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.geodesy import enu_axes, to_ecef
from pipeline.io.projection import Projection, read_projection
from pipeline.scene.georeference import GeographicOrigin, Georeference

Array = NDArray[np.float64]

#: The step of the derivatives of a projection, metres.
_STEP_M = 10.0


def to_earth(georeference: Georeference) -> Array | None:
    """(4, 4) affine transformation of the scene's frame to ECEF, metres; None for a scene that is
    not placed on the earth.

    A frame in a projection is linearised at its origin. Heights are taken as ellipsoidal: neither
    EXIF altitudes nor heights of ground control points are reduced by a geoid. An unknown altitude
    is 0.
    """
    origin = georeference.origin
    if isinstance(origin, GeographicOrigin) and georeference.is_metric:
        at = np.array([origin.latitude, origin.longitude, origin.altitude or 0.0])
        return _affine(enu_axes(at), to_ecef(at))
    if georeference.projected_origin is None or georeference.projection is None:
        return None
    projection = read_projection(georeference.projection)
    steps = _STEP_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    points = _projected_to_ecef(projection, georeference.projected_origin + steps)
    return _affine((points[1:4] - points[4:]).T / (2 * _STEP_M), points[0])


def _projected_to_ecef(projection: Projection, metres: Array) -> Array:
    """(N, 3) coordinates in a projection, in metres, to ECEF."""
    horizontal = metres[:, :2] / projection.horizontal
    longitude_latitude = projection.longitude_latitude(horizontal)
    return to_ecef(np.column_stack([longitude_latitude[:, ::-1], metres[:, 2]]))


def _affine(linear: Array, translation: Array) -> Array:
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = linear, translation
    return found
