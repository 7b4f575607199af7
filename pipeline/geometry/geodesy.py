"""Geodetic (WGS84) to Earth-centred (ECEF) and local east-north-up (ENU) coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# WGS84. Source: NIMA TR8350.2, table 3.1.
SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
_E2 = FLATTENING * (2 - FLATTENING)


def to_ecef(geodetic: Array) -> Array:
    """Geodetic to Earth-centred, Earth-fixed coordinates.

    Args:
        geodetic: (..., 3) latitude and longitude in degrees, ellipsoidal height in metres.

    Returns:
        (..., 3) metres.
    """
    geodetic = np.asarray(geodetic, np.float64)
    latitude, longitude = np.radians(geodetic[..., 0]), np.radians(geodetic[..., 1])
    height = geodetic[..., 2]
    normal = SEMI_MAJOR_M / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    axis_distance = (normal + height) * np.cos(latitude)
    return np.stack(
        [
            axis_distance * np.cos(longitude),
            axis_distance * np.sin(longitude),
            (normal * (1 - _E2) + height) * np.sin(latitude),
        ],
        axis=-1,
    )


def to_enu(geodetic: Array, origin: Array) -> Array:
    """Geodetic to local east-north-up coordinates.

    Args:
        geodetic: (..., 3) latitude and longitude in degrees, ellipsoidal height in metres.
        origin: (3,) latitude, longitude and height of the local frame's origin.

    Returns:
        (..., 3) metres east, north and up of ``origin``.
    """
    away = to_ecef(geodetic) - to_ecef(np.asarray(origin, np.float64))
    return np.asarray(away @ enu_axes(origin))


def enu_axes(origin: Array) -> Array:
    """(3, 3) east, north and up at (3,) ``origin`` in Earth-centred coordinates, as columns."""
    latitude, longitude = np.radians(origin[0]), np.radians(origin[1])
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
            [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
            [0.0, cos_lat, sin_lat],
        ]
    )
