"""World frame of a reconstruction: metres east, north and up from GPS or ground control points,
otherwise level (y down) with unit scale.

Structure from motion determines a model up to a similarity (rotation, translation, scale). Ground
control points determine all seven parameters, and so does GPS that covers an area. GPS positions on
a line leave the roll about the line undetermined; it is taken from the up direction of the cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.geodesy import to_enu
from pipeline.geometry.similarity import (
    OUTLIER_SIGMAS,
    RobustFit,
    Similarity,
    robust_similarity,
)
from pipeline.io.gcp import GroundControl
from pipeline.scene.georeference import (
    CartesianOrigin,
    GeographicOrigin,
    Georeference,
    Origin,
    Residual,
    ResidualSummary,
)

Array = NDArray[np.float64]
Method = Literal["gcp", "gps", "level"]

# Standard deviation of GPS altitudes over that of horizontal positions.
ALTITUDE_RATIO = 3.0
# Lower bound on the estimated standard deviation, metres: a fit to few positions underestimates it.
GPS_FLOOR_M, GCP_FLOOR_M = 0.02, 0.001
# Smallest ratio of the positions' spread to the standard deviation of their residuals.
MIN_SPREAD = 3.0
# If positions determine the tilt less precisely than this, it is taken from the cameras.
MAX_TILT_RAD = float(np.radians(4.0))
MIN_POSITIONS = 3
# Without a georeference the scene is scaled so that this share of the camera centres lies within
# this distance of their mean.
LEVEL_RADIUS, LEVEL_SHARE = 1.0, 0.95


@dataclass(frozen=True)
class Cameras:
    """Registered photographs: names, (N, 3) camera centres, (3,) estimated up direction (unit
    vector)."""

    names: list[str]
    centres: Array
    up: Array


@dataclass(frozen=True)
class WorldFrame:
    """World frame of a model.

    Attributes:
        method: source of the frame.
        similarity: from the mapper's world to this frame.
        origin: of the frame: geographic (GPS, or geographic GCPs), or in ``projection``; None for
            "level".
        projection: the GCP file's, None otherwise.
        residuals: of each photograph (GPS) or point (GCP).
        decisions, warnings: sentences for the log.
    """

    method: Method
    similarity: Similarity
    origin: Origin | None = None
    projection: str | None = None
    residuals: tuple[Residual, ...] = ()
    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def georeference(self) -> Georeference:
        """The content of ``georeference.json``."""
        located = self.method != "level"
        return Georeference(
            method=self.method,
            axes="x east, y north, z up" if located else "y down; x and z level",
            unit="metres"
            if located
            else f"{LEVEL_SHARE:.0%} of the cameras lie within {LEVEL_RADIUS:g} of their mean",
            origin=self.origin,
            projection=self.projection,
            scale=self.similarity.scale,
            rotation=self.similarity.rotation.tolist(),
            translation=self.similarity.translation.tolist(),
            residuals_m=summary(self.residuals),
            residuals=self.residuals,
        )


def summary(residuals: Sequence[Residual]) -> ResidualSummary | None:
    """Median and maximum of the used residuals, metres; None without any."""
    used = [r for r in residuals if r.used]
    if not used:
        return None
    horizontal = np.array([r.horizontal_m for r in used])
    vertical = np.abs([r.vertical_m for r in used])
    return ResidualSummary(
        used=len(used),
        left_out=len(residuals) - len(used),
        horizontal_median=float(np.median(horizontal)),
        horizontal_max=float(horizontal.max()),
        vertical_median=float(np.median(vertical)),
        vertical_max=float(vertical.max()),
    )


def level(cameras: Cameras) -> WorldFrame:
    """Level frame: y down, origin at the mean camera centre, scaled to ``LEVEL_RADIUS``."""
    mean = cameras.centres.mean(0)
    distances = np.linalg.norm(cameras.centres - mean, axis=1)
    size = float(np.quantile(distances, LEVEL_SHARE, method="higher"))
    scale = LEVEL_RADIUS / size if size > 1e-12 else 1.0
    rotation = _rotation_between(cameras.up, np.array([0.0, -1.0, 0.0]))
    return WorldFrame(
        "level",
        Similarity(scale, rotation, -scale * rotation @ mean),
        decisions=[
            "no georeference: the scene is level (y down) and scaled by the extent of its cameras"
        ],
    )


def from_gps(
    cameras: Cameras, positions: dict[str, tuple[float, float, float]]
) -> WorldFrame | str:
    """Frame east, north, up around the positions' median, or the reason why there is none.

    Args:
        positions: photograph's name -> latitude, longitude (degrees), altitude (metres).
    """
    known = [i for i, name in enumerate(cameras.names) if name in positions]
    if len(known) < MIN_POSITIONS:
        return f"only {len(known)} photographs with a pose have a GPS position"
    geodetic = np.array([positions[cameras.names[i]] for i in known], np.float64)
    # Longitudes relative to the first: the scene may span the date line.
    geodetic[:, 1] = geodetic[0, 1] + (geodetic[:, 1] - geodetic[0, 1] + 180) % 360 - 180
    origin = np.median(geodetic, axis=0)
    enu = to_enu(geodetic, origin)
    centres = cameras.centres[known]
    weight = np.array([1.0, 1.0, 1.0 / ALTITUDE_RATIO])
    found = robust_similarity(centres, enu, weight, GPS_FLOOR_M)
    tilt = np.inf if found is None else _tilt(enu, found[1], found[2])
    warnings: list[str] = []
    if found is None or tilt > MAX_TILT_RAD:
        levelled = _along_line(cameras.up, centres, enu)
        if isinstance(levelled, str):
            return levelled
        found = levelled
        warnings.append(
            "the GPS positions lie on a line and leave the roll about it undetermined: it is "
            "estimated from the orientation of the cameras"
        )
    similarity, used, sigma = found
    spread = float(np.linalg.svd(_centred(enu[used, :2]), compute_uv=False)[0])
    spread /= np.sqrt(max(int(used.sum()), 1))
    if spread < MIN_SPREAD * sigma:
        return (
            f"the GPS positions spread over {spread:.1f} m only, and their error is {sigma:.1f} m"
        )
    residual = similarity(centres) - enu
    records = _residual_records([cameras.names[i] for i in known], residual, used)
    totals = summary(records)
    assert totals is not None
    if totals.left_out:
        warnings.append(f"{totals.left_out} GPS positions are outliers and are left out")
    return WorldFrame(
        "gps",
        similarity,
        origin=_geographic(origin),
        residuals=records,
        decisions=[
            f"georeferenced by {totals.used} GPS positions: metres east, north and up of "
            f"{origin[0]:.6f}, {origin[1]:.6f}; median residual "
            f"{totals.horizontal_median:.2f} m horizontal, {totals.vertical_median:.2f} m vertical"
        ],
        warnings=warnings,
    )


def from_gcp(
    control: GroundControl, triangulate: Callable[[dict[str, tuple[float, float]]], Array | None]
) -> WorldFrame | str:
    """Frame of the ground control points, or the reason why there is none.

    Args:
        triangulate: photograph name -> pixel to the (3,) point in the mapper's world, None if it
            cannot be triangulated.
    """
    found = [(point, triangulate(point.pixels)) for point in control.points]
    placed = [(point, at) for point, at in found if at is not None]
    if len(placed) < MIN_POSITIONS:
        return (
            f"only {len(placed)} of {len(control.points)} ground control points are seen by two "
            "photographs with a pose"
        )
    places = np.array([point.position for point, _ in placed], np.float64)
    if control.geographic:
        origin = np.median(places, axis=0)[[1, 0, 2]]
        target = to_enu(places[:, [1, 0, 2]], origin)
        named: Origin = _geographic(origin)
    else:
        # Whole metres: adding the origin to coordinates is exact.
        origin = np.round(places.mean(0))
        target = places - origin
        x, y, z = origin.tolist()
        named = CartesianOrigin(x=x, y=y, z=z)
    source = np.array([at for _, at in placed])
    fitted = robust_similarity(source, target, np.ones(3), GCP_FLOOR_M)
    spread = np.linalg.svd(_centred(target), compute_uv=False)
    if fitted is None or spread[1] < 0.02 * spread[0]:
        return "the ground control points lie on a line"
    similarity, used, _ = fitted
    names_used = [point.name for point, _ in placed]
    records = _residual_records(names_used, similarity(source) - target, used)
    totals = summary(records)
    assert totals is not None
    warnings = []
    if totals.left_out:
        outliers = [record.name for record in records if not record.used]
        warnings.append(
            f"ground control points that are outliers are left out: {', '.join(outliers[:5])}"
        )
    if control.unknown:
        warnings.append(
            f"the ground control file names {len(control.unknown)} photographs that are not in the "
            f"scene: {', '.join(control.unknown[:5])}"
        )
    return WorldFrame(
        "gcp",
        similarity,
        origin=named,
        projection=control.projection,
        residuals=records,
        decisions=[
            f"georeferenced by {totals.used} ground control points ({control.projection}): "
            f"median residual {totals.horizontal_median:.3f} m horizontal, "
            f"{totals.vertical_median:.3f} m vertical"
        ],
        warnings=warnings,
    )


def _geographic(origin: Array) -> GeographicOrigin:
    latitude, longitude, altitude = origin.tolist()
    return GeographicOrigin(latitude=latitude, longitude=longitude, altitude=altitude)


def _residual_records(
    names: list[str], residual: Array, used: NDArray[np.bool_]
) -> tuple[Residual, ...]:
    return tuple(
        Residual(
            name=name,
            horizontal_m=round(float(np.hypot(r[0], r[1])), 4),
            vertical_m=round(float(r[2]), 4),
            used=bool(inlier),
        )
        for name, r, inlier in zip(names, residual, used, strict=True)
    )


def _tilt(target: Array, used: NDArray[np.bool_], sigma: float) -> float:
    """Uncertainty of the frame's tilt about its worst determined horizontal axis, radians."""
    flat = np.linalg.svd(_centred(target[used, :2]), compute_uv=False)
    return float(ALTITUDE_RATIO * sigma / max(float(flat[1]), 1e-12))


def _along_line(up: Array, centres: Array, enu: Array) -> RobustFit | str:
    """Similarity for positions on a line, or the reason why there is none.

    The up direction is taken from the cameras; heading, scale and horizontal translation from the
    horizontal positions (by exhaustive pairs, then least squares on the inliers), the vertical
    translation from their median.
    """
    upright = _rotation_between(up, np.array([0.0, 0.0, 1.0]))
    flat = centres @ upright.T
    lengths = np.linalg.svd(_centred(flat), compute_uv=False)
    along = np.linalg.svd(_centred(flat))[2][0]
    if abs(along[2]) > np.sin(np.radians(60)) or lengths[0] < 1e-9:
        return "the GPS positions lie on a line along the up direction of the cameras"
    flat_on_ground = np.column_stack([flat[:, :2], np.zeros(len(flat))])
    ground = np.column_stack([enu[:, :2], np.zeros(len(enu))])
    best: tuple[float, Similarity] | None = None
    count = len(flat)
    for i in range(count):
        for j in range(i + 1, count) if count <= 60 else range(i + 1, count, count // 30):
            proposal = _flat_similarity(flat_on_ground[[i, j]], ground[[i, j]])
            errors = np.linalg.norm(proposal(flat_on_ground)[:, :2] - enu[:, :2], axis=1)
            score = float(np.median(errors))
            if best is None or score < best[0]:
                best = (score, proposal)
    assert best is not None
    sigma = max(best[0] / 1.1774, GPS_FLOOR_M)
    used = (
        np.linalg.norm(best[1](flat_on_ground)[:, :2] - enu[:, :2], axis=1)
        <= OUTLIER_SIGMAS * sigma
    )
    fitted = _flat_similarity(flat_on_ground[used], ground[used])
    errors = np.linalg.norm(fitted(flat_on_ground)[:, :2] - enu[:, :2], axis=1)
    # 1.1774 is the median of the Rayleigh distribution.
    sigma = max(float(np.median(errors[used])) / 1.1774, GPS_FLOOR_M)
    height = float(np.median(enu[used, 2] - fitted.scale * flat[used, 2]))
    shift = fitted.translation + np.array([0.0, 0.0, height])
    return RobustFit(Similarity(fitted.scale, fitted.rotation @ upright, shift), used, sigma)


def _flat_similarity(source: Array, target: Array) -> Similarity:
    """Least squares similarity of the ground plane (z = 0) that rotates about z only."""
    a, b = _centred(source)[:, :2], _centred(target)[:, :2]
    dot, cross = float((a * b).sum()), float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    size = np.hypot(dot, cross)
    c, s = (dot / size, cross / size) if size > 0 else (1.0, 0.0)
    scale = float(size / max(float((a**2).sum()), 1e-300))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))


def _centred(points: Array) -> Array:
    return points - points.mean(0)


def _rotation_between(source: Array, target: Array) -> Array:
    """The smallest rotation that maps one unit vector to another."""
    axis = np.cross(source, target)
    cosine = float(source @ target)
    if cosine < -1 + 1e-12:
        # Half a turn about any perpendicular axis.
        other = np.eye(3)[np.abs(source).argmin()]
        axis = np.cross(source, other)
        axis /= np.linalg.norm(axis)
        return np.asarray(2 * np.outer(axis, axis) - np.eye(3))
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + cosine))
