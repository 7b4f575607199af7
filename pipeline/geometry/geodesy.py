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


def from_enu(local: Array, origin: Array) -> Array:
    """Local east-north-up to geodetic coordinates: the inverse of ``to_enu``.

    Latitude and height by Bowring's formula (1976), repeated until it is exact to rounding.

    Args:
        local: (..., 3) metres east, north and up of ``origin``.
        origin: (3,) latitude, longitude and height of the local frame's origin.
    """
    ecef = np.einsum("...i,ji->...j", np.asarray(local, np.float64), enu_axes(origin))
    x, y, z = np.moveaxis(ecef + to_ecef(np.asarray(origin, np.float64)), -1, 0)
    axis_distance = np.hypot(x, y)
    semi_minor = SEMI_MAJOR_M * (1 - FLATTENING)
    # The parametric latitude; a point on the axis has a distance of 0.
    parametric = np.arctan2(z * SEMI_MAJOR_M, axis_distance * semi_minor)
    for _ in range(3):
        latitude = np.arctan2(
            z + _E2 / (1 - _E2) * semi_minor * np.sin(parametric) ** 3,
            axis_distance - _E2 * SEMI_MAJOR_M * np.cos(parametric) ** 3,
        )
        parametric = np.arctan2((1 - FLATTENING) * np.sin(latitude), np.cos(latitude))
    normal = SEMI_MAJOR_M / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    # Exact at the poles too, where the distance from the axis over the cosine is not.
    height = (
        axis_distance * np.cos(latitude)
        + (z + _E2 * normal * np.sin(latitude)) * np.sin(latitude)
        - normal
    )
    longitude = np.degrees(np.arctan2(y, x))
    # Not across the date line from the origin.
    longitude = origin[1] + (longitude - origin[1] + 180) % 360 - 180
    return np.stack([np.degrees(latitude), longitude, height], axis=-1)


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
