"""The frame a reconstruction is given: metres east, north and up where GPS or ground control points
say where that is, else level, with y down, and of a known size.

Mapping leaves seven numbers open: a turn, a place, a scale. Everything here finds them; the model
itself is not bent. Ground control points settle all seven; GPS does where it spreads over an area.
Along a line it leaves the roll about it open, which the cameras' own idea of up settles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

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

Array = NDArray[np.float64]
Method = Literal["gcp", "gps", "level"]

# GPS measures heights worse than places on the ground, about so many times.
ALTITUDE_RATIO = 3.0
# What phones reach at best; a fit to a handful of positions may look better than it is.
GPS_FLOOR_M, GCP_FLOOR_M = 0.02, 0.001
# Positions must spread by so many times their residuals, or their residuals make the frame.
MIN_SPREAD = 3.0
# A tilt that the positions leave uncertain by more than this is left to the cameras.
MAX_TILT_RAD = float(np.radians(4.0))
MIN_POSITIONS = 3
# Cameras of a scene without a place lie within this distance of their mean, all but the farthest.
LEVEL_RADIUS, LEVEL_SHARE = 1.0, 0.95


@dataclass(frozen=True)
class Cameras:
    """Registered photographs: names, (N, 3) centres, (3,) what they hold up (unit vector)."""

    names: list[str]
    centres: Array
    up: Array


@dataclass(frozen=True)
class Frame:
    """The frame found for a model.

    Attributes:
        method: what it rests on.
        similarity: takes the mapper's world to it.
        origin: where its zero is: latitude, longitude, altitude (GPS, or geographic GCPs), or x,
            y, z in ``projection``; None without a place.
        projection: the GCP file's, None otherwise.
        residuals: how far what it rests on is from the model, metres: for each photograph (GPS)
            or point (GCP) name, horizontal, vertical, used.
        decisions, warnings: for people.
    """

    method: Method
    similarity: Similarity
    origin: dict[str, float] | None = None
    projection: str | None = None
    residuals: list[dict[str, Any]] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def sidecar(self) -> dict[str, Any]:
        """The content of ``georeference.json``."""
        located = self.method != "level"
        return {
            "method": self.method,
            "axes": "x east, y north, z up" if located else "y down; x and z level",
            "unit": "metres"
            if located
            else f"{LEVEL_SHARE:.0%} of the cameras lie within {LEVEL_RADIUS:g} of their mean",
            "origin": self.origin,
            "projection": self.projection,
            "scale": self.similarity.scale,
            "rotation": self.similarity.rotation.tolist(),
            "translation": self.similarity.translation.tolist(),
            "residuals_m": summary(self.residuals),
            "residuals": self.residuals,
        }


def summary(residuals: list[dict[str, Any]]) -> dict[str, float | int] | None:
    """Medians and largest of the residuals that were used, metres; None without any."""
    used = [r for r in residuals if r["used"]]
    if not used:
        return None
    flat, tall = (np.array([r[k] for r in used]) for k in ("horizontal_m", "vertical_m"))
    return {
        "used": len(used),
        "left_out": len(residuals) - len(used),
        "horizontal_median": float(np.median(flat)),
        "horizontal_max": float(flat.max()),
        "vertical_median": float(np.median(np.abs(tall))),
        "vertical_max": float(np.abs(tall).max()),
    }


def level(cameras: Cameras) -> Frame:
    """Level, y down, the cameras' mean at 0 and most of them within ``LEVEL_RADIUS``."""
    mean = cameras.centres.mean(0)
    distances = np.linalg.norm(cameras.centres - mean, axis=1)
    size = float(np.quantile(distances, LEVEL_SHARE, method="higher"))
    scale = LEVEL_RADIUS / size if size > 1e-12 else 1.0
    rotation = _turn(cameras.up, np.array([0.0, -1.0, 0.0]))
    return Frame(
        "level",
        Similarity(scale, rotation, -scale * rotation @ mean),
        decisions=["the scene is level (y down) and scaled to its cameras: nothing gives its size"],
    )


def from_gps(cameras: Cameras, positions: dict[str, tuple[float, float, float]]) -> Frame | str:
    """The frame east, north, up around the positions' mean, or why there is none.

    Args:
        positions: photograph's name -> latitude, longitude (degrees), altitude (metres).
    """
    known = [i for i, name in enumerate(cameras.names) if name in positions]
    if len(known) < MIN_POSITIONS:
        return f"only {len(known)} photographs with a pose have a GPS position"
    geodetic = np.array([positions[cameras.names[i]] for i in known], np.float64)
    # Relative to the first, so that the date line does not tear a scene apart.
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
            "the GPS positions lie on a line and leave the roll about it open: it is what the "
            "cameras hold up"
        )
    similarity, used, sigma = found
    spread = float(np.linalg.svd(_centred(enu[used, :2]), compute_uv=False)[0])
    spread /= np.sqrt(max(int(used.sum()), 1))
    if spread < MIN_SPREAD * sigma:
        return (
            f"the GPS positions spread over {spread:.1f} m only and miss the reconstruction by "
            f"{sigma:.1f} m"
        )
    residual = similarity(centres) - enu
    rows = _rows([cameras.names[i] for i in known], residual, used)
    told = summary(rows)
    assert told is not None
    if told["left_out"]:
        warnings.append(f"{told['left_out']} GPS positions contradict the others and are left out")
    return Frame(
        "gps",
        similarity,
        origin=dict(zip(("latitude", "longitude", "altitude"), origin.tolist(), strict=True)),
        residuals=rows,
        decisions=[
            f"georeferenced by {told['used']} GPS positions: metres east, north and up of "
            f"{origin[0]:.6f}, {origin[1]:.6f}; median residual "
            f"{told['horizontal_median']:.2f} m on the ground, {told['vertical_median']:.2f} m up"
        ],
        warnings=warnings,
    )


def from_gcp(
    control: GroundControl, triangulate: Callable[[dict[str, tuple[float, float]]], Array | None]
) -> Frame | str:
    """The frame of ground control points, or why there is none.

    Args:
        triangulate: (3,) where photographs' pixels meet in the mapper's world, None where they
            do not.
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
        names = ("latitude", "longitude", "altitude")
    else:
        # Whole metres: what is added back to reach the projection's own coordinates stays exact.
        origin = np.round(places.mean(0))
        target = places - origin
        names = ("x", "y", "z")
    source = np.array([at for _, at in placed])
    fitted = robust_similarity(source, target, np.ones(3), GCP_FLOOR_M)
    spread = np.linalg.svd(_centred(target), compute_uv=False)
    if fitted is None or spread[1] < 0.02 * spread[0]:
        return "the ground control points lie on a line"
    similarity, used, _ = fitted
    rows = _rows([point.name for point, _ in placed], similarity(source) - target, used)
    told = summary(rows)
    assert told is not None
    warnings = []
    if told["left_out"]:
        bad = [row["name"] for row in rows if not row["used"]]
        warnings.append(
            f"ground control points that contradict the others are left out: {', '.join(bad[:5])}"
        )
    if control.unknown:
        warnings.append(
            f"ground control points name {len(control.unknown)} photographs that are not here: "
            f"{', '.join(control.unknown[:5])}"
        )
    return Frame(
        "gcp",
        similarity,
        origin=dict(zip(names, origin.tolist(), strict=True)),
        projection=control.projection,
        residuals=rows,
        decisions=[
            f"georeferenced by {told['used']} ground control points ({control.projection}): median "
            f"residual {told['horizontal_median']:.3f} m on the ground, "
            f"{told['vertical_median']:.3f} m up"
        ],
        warnings=warnings,
    )


def _rows(names: list[str], residual: Array, used: NDArray[np.bool_]) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "horizontal_m": round(float(np.hypot(r[0], r[1])), 4),
            "vertical_m": round(float(r[2]), 4),
            "used": bool(kept),
        }
        for name, r, kept in zip(names, residual, used, strict=True)
    ]


def _tilt(target: Array, used: NDArray[np.bool_], sigma: float) -> float:
    """Radians by which positions leave the worst determined tilt of the frame uncertain."""
    flat = np.linalg.svd(_centred(target[used, :2]), compute_uv=False)
    return float(ALTITUDE_RATIO * sigma / max(float(flat[1]), 1e-12))


def _along_line(up: Array, centres: Array, enu: Array) -> RobustFit | str:
    """With up from the cameras: heading, scale and place from the positions on the ground, the
    height from their median."""
    upright = _turn(up, np.array([0.0, 0.0, 1.0]))
    flat = centres @ upright.T
    lengths = np.linalg.svd(_centred(flat), compute_uv=False)
    along = np.linalg.svd(_centred(flat))[2][0]
    if abs(along[2]) > np.sin(np.radians(60)) or lengths[0] < 1e-9:
        return "the GPS positions lie on a line along which the cameras hold their pictures"
    plain = np.column_stack([flat[:, :2], np.zeros(len(flat))])
    ground = np.column_stack([enu[:, :2], np.zeros(len(enu))])
    best: tuple[float, Similarity] | None = None
    count = len(flat)
    for i in range(count):
        for j in range(i + 1, count) if count <= 60 else range(i + 1, count, count // 30):
            proposal = _flat_similarity(plain[[i, j]], ground[[i, j]])
            misses = np.linalg.norm(proposal(plain)[:, :2] - enu[:, :2], axis=1)
            score = float(np.median(misses))
            if best is None or score < best[0]:
                best = (score, proposal)
    assert best is not None
    sigma = max(best[0] / 1.1774, GPS_FLOOR_M)
    used = np.linalg.norm(best[1](plain)[:, :2] - enu[:, :2], axis=1) <= OUTLIER_SIGMAS * sigma
    fitted = _flat_similarity(plain[used], ground[used])
    misses = np.linalg.norm(fitted(plain)[:, :2] - enu[:, :2], axis=1)
    sigma = max(float(np.median(misses[used])) / 1.1774, GPS_FLOOR_M)
    height = float(np.median(enu[used, 2] - fitted.scale * flat[used, 2]))
    shift = fitted.translation + np.array([0.0, 0.0, height])
    return RobustFit(Similarity(fitted.scale, fitted.rotation @ upright, shift), used, sigma)


def _flat_similarity(source: Array, target: Array) -> Similarity:
    """The similarity of the ground plane (z = 0) that keeps up up, least squares."""
    a, b = _centred(source)[:, :2], _centred(target)[:, :2]
    dot, cross = float((a * b).sum()), float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    size = np.hypot(dot, cross)
    c, s = (dot / size, cross / size) if size > 0 else (1.0, 0.0)
    scale = float(size / max(float((a**2).sum()), 1e-300))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))


def _centred(points: Array) -> Array:
    return points - points.mean(0)


def _turn(source: Array, target: Array) -> Array:
    """The smallest rotation that takes one unit vector to another."""
    axis = np.cross(source, target)
    cosine = float(source @ target)
    if cosine < -1 + 1e-12:
        # Half a turn about whatever is perpendicular.
        other = np.eye(3)[np.abs(source).argmin()]
        axis = np.cross(source, other)
        axis /= np.linalg.norm(axis)
        return np.asarray(2 * np.outer(axis, axis) - np.eye(3))
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + cosine))
