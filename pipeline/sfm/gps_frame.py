"""World frame from the photographs' GPS positions.

Positions that cover an area determine all seven parameters. Positions on a line, and positions
without altitudes, leave the tilt undetermined; it is taken from the orientation of the cameras.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.geodesy import to_enu
from pipeline.geometry.similarity import Noise, RobustFit, centred, robust_similarity
from pipeline.geometry.upright_similarity import upright_similarity
from pipeline.scene.georeference import GeographicOrigin
from pipeline.sfm.georeference import (
    CAMERA_TILT_RAD,
    MIN_POSITIONS,
    Cameras,
    WorldFrame,
    fitted_frame,
    local_frame,
    rotation_between,
    undetermined,
)

Array = NDArray[np.float64]
Positions = Mapping[str, tuple[float, float, float | None]]
"""Photograph's name -> latitude, longitude (degrees), altitude (metres, None if unknown)."""

# Errors of consumer GPS, metres, and the ratio of vertical to horizontal errors.
GPS_NOISE = Noise(3.0)
ALTITUDE_RATIO = 3.0
# Angle at which the up direction of positions contradicts that of the cameras, and how much larger
# horizontal residuals may be with that of the cameras.
MAX_ANGLE_RAD, MUCH_WORSE = float(np.radians(20.0)), 2.0
# The view downwards as up direction replaces that of the images' tops if it fits so much better.
BETTER_FIT = 0.5
# Largest standard deviation of positions that are used: metres, or this share of their extent up to
# so many metres, since poses of a long route drift.
MAX_SIGMA_M, MAX_SIGMA_SHARE, MAX_DRIFT_M = 50.0, 0.02, 1000.0
# Altitudes are in feet if they vary by this factor, less or more by this share, and by so many
# standard deviations more than the heights of the cameras; from so many positions.
FEET_PER_M, FEET_TOLERANCE, FEET_SIGMAS, FEET_POSITIONS = 1 / 0.3048, 0.2, 5.0, 8
# Positions within this angle of the vertical do not determine the heading.
_MIN_SLOPE = float(np.sin(np.radians(60.0)))


class _Measured(NamedTuple):
    """Positions: local metres (N, 3) with 0 for unknown heights, weights (N, 3), and the origin."""

    enu: Array
    weight: Array
    origin: GeographicOrigin


def from_gps(cameras: Cameras, positions: Positions) -> WorldFrame | str:
    """Frame east, north, up around the positions' median, or the reason why there is none."""
    known = [i for i, name in enumerate(cameras.names) if name in positions]
    if len(known) < MIN_POSITIONS:
        return (
            f"only {len(known)} photographs with a pose have a GPS position; "
            f"{MIN_POSITIONS} are needed"
        )
    measured = _local([positions[cameras.names[i]] for i in known])
    centres = cameras.centres[known]
    found = _fitted(centres, measured, cameras)
    if isinstance(found, str):
        return found
    fit, tilt_from, warnings = found
    if (reason := undetermined(fit)) is not None:
        size = float(np.sqrt((centred(measured.enu[fit.inliers, :2]) ** 2).sum(1).mean()))
        return f"the GPS positions spread over {size:.1f} m: {reason}"
    extent = float(np.abs(measured.enu[:, :2]).max())
    if fit.sigma > max(MAX_SIGMA_M, min(MAX_SIGMA_SHARE * extent, MAX_DRIFT_M)):
        return (
            f"the GPS positions contradict each other, or the poses, by about {fit.sigma:.3g} m: "
            "check the hemispheres (N, S, E, W) and the signs of latitude and longitude"
        )
    contradiction = cameras.contradiction(fit.similarity)
    if contradiction == "upside down":
        return (
            "the photographs would be upside down. The positions are mirrored: check the "
            "hemispheres (N, S, E, W) and the signs of latitude and longitude"
        )
    if contradiction is not None:
        warnings.append(
            f"in the frame of the GPS positions the photographs are {contradiction}: check that "
            "the scene is upright, or set sfm.georeference: none"
        )
    if _in_feet(centres, measured, cameras):
        warnings.append(
            "the GPS altitudes seem to be in feet: they vary about three times as much as the "
            "heights of the cameras; EXIF's unit is the metre: check and convert them"
        )
    residual = fit.similarity(centres) - measured.enu
    residual[measured.weight[:, 2] == 0, 2] = np.nan
    names = [cameras.names[i] for i in known]
    if left_out := [names[i] for i in np.flatnonzero(~fit.inliers)]:
        warnings.append(
            f"{len(left_out)} GPS positions are outliers and are left out (first: {left_out[0]})"
        )
    origin = measured.origin
    frame = WorldFrame(
        "gps", fit.similarity, origin, fit=fit, tilt_from=tilt_from, warnings=warnings
    )
    place = (
        f" of {len(cameras.names)} photographs: metres east, north and up of "
        f"{origin.latitude:.6f}, {origin.longitude:.6f};"
    )
    return fitted_frame(frame, "GPS positions", place, names, residual)


def local_metres(degrees: Array, origin: Array) -> Array:
    """(N, 2) metres east and north of ``origin`` (latitude, longitude, height) for (N, 2) latitudes
    and longitudes, for comparison."""
    geodetic = np.column_stack([degrees, np.full(len(degrees), origin[2])])
    return to_enu(geodetic, origin)[:, :2]


def _local(positions: list[tuple[float, float, float | None]]) -> _Measured:
    geodetic = np.array([[np.nan if v is None else v for v in p] for p in positions], np.float64)
    weight = np.tile([1.0, 1.0, 1.0 / ALTITUDE_RATIO], (len(geodetic), 1))
    weight[np.isnan(geodetic[:, 2]), 2] = 0.0
    enu, origin = local_frame(geodetic)
    return _Measured(enu, weight, origin)


def _fitted(
    centres: Array, measured: _Measured, cameras: Cameras
) -> tuple[RobustFit, Literal["positions", "cameras"], list[str]] | str:
    """The fit, what determines its tilt, and warnings; or the reason why there is none."""
    enu, weight, _ = measured
    fit = robust_similarity(centres, enu, weight, GPS_NOISE)
    if fit is not None and fit.uncertainty.tilt <= CAMERA_TILT_RAD:
        upright = _instead(fit, centres, measured, cameras)
        if upright is None:
            return fit, "positions", []
        angle = np.degrees(np.arccos(np.clip(fit.similarity.rotation[2] @ cameras.up, -1, 1)))
        text = (
            f"the altitudes of the GPS positions contradict the orientation of the cameras by "
            f"{angle:.0f} degrees: the tilt is estimated from the cameras"
        )
        return upright, "cameras", [text]
    found: list[tuple[RobustFit, bool]] = []
    vertical = False
    for up, downwards in _up_candidates(cameras):
        levelled = _upright(up, centres, measured)
        vertical = vertical or levelled is None
        if levelled is not None:
            found.append((levelled, downwards))
    if not found:
        line = " along the up direction of the cameras" if vertical else ""
        return f"the GPS positions lie on a line{line}"
    best, downwards = found[0]
    if len(found) > 1 and _misfit(found[1][0]) < BETTER_FIT * _misfit(best):
        best, downwards = found[1]
    # The tilt is taken from the cameras where they determine it better than the positions.
    why = "lie on a line, or are too few or too narrow, and leave the tilt undetermined"
    if not weight[:, 2].any():
        why = "have no altitude and leave the tilt undetermined"
    assumed = ", as if they looked straight down" if downwards else ""
    text = f"the GPS positions {why}: it is estimated from the orientation of the cameras{assumed}"
    return best, "cameras", [text]


def _upright(up: Array, centres: Array, measured: _Measured) -> RobustFit | None:
    """The fit with an up direction; None if the positions lie along it."""
    turn = rotation_between(up, np.array([0.0, 0.0, 1.0]))
    along = np.linalg.svd(centred(centres @ turn.T))[2][0]
    if abs(along[2]) > _MIN_SLOPE:
        return None
    fit = upright_similarity(
        centres @ turn.T, measured.enu, measured.weight, GPS_NOISE, CAMERA_TILT_RAD
    )
    if fit is None:
        return None
    rotation = fit.similarity.rotation @ turn
    return fit._replace(similarity=replace(fit.similarity, rotation=rotation))


def _instead(
    fit: RobustFit, centres: Array, measured: _Measured, cameras: Cameras
) -> RobustFit | None:
    """The fit with the cameras' up direction, if that of ``fit`` differs from it by more than its
    standard deviation explains, and the horizontal positions fit nearly as well: altitudes, which
    drift, are then what is wrong."""
    angle = float(np.arccos(np.clip(fit.similarity.rotation[2] @ cameras.up, -1, 1)))
    if angle < max(MAX_ANGLE_RAD, 3 * float(np.hypot(fit.uncertainty.tilt, CAMERA_TILT_RAD))):
        return None
    upright = _upright(cameras.up, centres, measured)
    if upright is None:
        return None
    errors = [
        float(np.median(np.linalg.norm((f.similarity(centres) - measured.enu)[:, :2], axis=1)))
        for f in (fit, upright)
    ]
    return upright if errors[1] <= max(MUCH_WORSE * errors[0], GPS_NOISE.sigma) else None


def _in_feet(centres: Array, measured: _Measured, cameras: Cameras) -> bool:
    """Whether altitudes vary as feet would, in a frame that is fitted to horizontal positions."""
    horizontal = measured._replace(weight=measured.weight * [1.0, 1.0, 0.0])
    fit = _upright(cameras.up, centres, horizontal)
    if fit is None:
        return False
    known = (measured.weight[:, 2] > 0) & fit.inliers
    if known.sum() < FEET_POSITIONS:
        return False
    places = centred(fit.similarity(centres[known]))
    altitudes = measured.enu[known, 2] - measured.enu[known, 2].mean()
    # Altitudes are fitted with x and y as well, since the tilt of the frame is inaccurate.
    factors, _, rank, _ = np.linalg.lstsq(places, altitudes, rcond=1e-9)
    if rank < 3:
        return False
    errors = altitudes - places @ factors
    variance = float(errors @ errors) / (len(errors) - 4) * np.linalg.inv(places.T @ places)[2, 2]
    factor = float(factors[2])
    return abs(factor / FEET_PER_M - 1) < FEET_TOLERANCE and factor - 1 > FEET_SIGMAS * float(
        np.sqrt(variance)
    )


def _misfit(fit: RobustFit) -> float:
    """The standard deviation of the residuals, if outliers had as large ones as the fit allows."""
    return fit.sigma * len(fit.inliers) / max(int(fit.inliers.sum()), 1)


def _up_candidates(cameras: Cameras) -> list[tuple[Array, bool]]:
    """Up directions from the orientations: that of the images' tops; and the opposite of the
    viewing direction where all cameras look the same way and may look straight down."""
    found = [(cameras.up, False)]
    if cameras.directions is not None:
        ahead = cameras.directions.ahead.mean(0)
        length = float(np.linalg.norm(ahead))
        if length > 0.8 and float(-ahead @ cameras.up) / length < np.cos(np.radians(30)):
            found.append((-ahead / length, True))
    return found
