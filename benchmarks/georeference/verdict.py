"""Whether a found frame is right, refused, stated, warned of or silently wrong."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from benchmarks.georeference.cases import CASES, Found
from benchmarks.results import GeoreferenceResult
from pipeline.geometry.geodesy import to_enu
from pipeline.scene.georeference import GeographicOrigin
from pipeline.sfm.georeference import WorldFrame, uncertainty

Array = NDArray[np.float64]

# A frame is close to the truth up to these errors, of GPS and of ground control points: the scale,
# angles in degrees, metres horizontally and vertically.
CLOSE = {"gps": (0.03, 3.0, 6.0, 15.0), "gcp": (0.01, 1.0, 1.0, 1.0)}
# The number of stated standard deviations up to which they explain an error.
SIGMAS = 4.0
#: Words of messages that say that the frame may be wrong.
DOUBTS = ("contradict", "check", "left out", "wrong", "are not used", "upside down", "outside of")


def judged(seed: int) -> Iterator[GeoreferenceResult]:
    """Run every case."""
    for number, (name, case) in enumerate(CASES.items()):
        yield verdict(name, case(np.random.default_rng([seed, number])), seed)


def verdict(name: str, found: Found, seed: int) -> GeoreferenceResult:
    said = " | ".join(found.said)
    if found.frame is None:
        return GeoreferenceResult(name, seed, "refused" if said else "silently wrong", said, None)
    errors = frame_errors(found)
    close = CLOSE[found.frame.method]
    assert found.frame.fit is not None
    known = uncertainty(found.frame.fit, found.frame.tilt_from)
    # The distance of the cameras from each other and from the points.
    size = float(np.linalg.norm(found.survey.enu, axis=1).max())
    angle = max(known.heading_deg, known.tilt_deg)
    place = size * (known.scale + np.radians(angle))
    stated = (known.scale, angle, place, place)
    if all(error <= limit for error, limit in zip(errors, close, strict=True)):
        outcome = "right"
    elif all(
        error <= limit + SIGMAS * sigma
        for error, limit, sigma in zip(errors, close, stated, strict=True)
    ):
        outcome = "stated"
    elif any(word in said for word in DOUBTS):
        outcome = "warned"
    else:
        outcome = "silently wrong"
    return GeoreferenceResult(name, seed, outcome, said, errors)


def frame_errors(found: Found) -> tuple[float, float, float, float]:
    """The relative error of the scale; the largest angle between true and found directions,
    degrees; and the largest errors of the cameras' places, horizontally and vertically, metres."""
    survey, frame = found.survey, found.frame
    assert frame is not None
    ours = frame.similarity(survey.cameras.centres)
    true = true_places(found, frame)
    # Both are centred, because projections stretch lengths and turn the north.
    a, b = ours - ours.mean(0), true - true.mean(0)
    u, singular, vt = np.linalg.svd(a.T @ b)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ sign @ vt
    scale = float(np.sqrt((a**2).sum() / max(float((b**2).sum()), 1e-12)))
    angle = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    if np.linalg.matrix_rank(b, tol=0.05 * float(singular.max()) ** 0.5) < 2:
        angle = turned(found, frame)
    off = ours - true
    vertical = np.abs(off[:, 2]).max()
    if isinstance(frame.origin, GeographicOrigin) and frame.origin.altitude is None:
        vertical = np.abs(off[:, 2] - off[:, 2].mean()).max()
    return (
        abs(scale - 1),
        angle,
        float(np.linalg.norm(off[:, :2], axis=1).max()),
        float(vertical),
    )


def turned(found: Found, frame: WorldFrame) -> float:
    """The angle between found and true rotation, degrees, where the cameras are on a line."""
    turn = frame.similarity.rotation @ found.survey.model.rotation.T
    return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))


def true_places(found: Found, frame: WorldFrame) -> Array:
    """The true places of the cameras in the coordinates of the found frame, (N, 3)."""
    survey, origin = found.survey, frame.origin
    places = survey.geodetic(survey.enu)
    if isinstance(origin, GeographicOrigin):
        altitude = survey.origin[2] if origin.altitude is None else origin.altitude
        return to_enu(places, np.array([origin.latitude, origin.longitude, altitude]))
    assert frame.projection is not None and origin is not None
    transformer = Transformer.from_crs(4326, frame.projection.crs, always_xy=True)
    x, y = transformer.transform(places[:, 1], places[:, 0])
    horizontal = frame.projection.horizontal
    projected = np.column_stack([np.array(x) * horizontal, np.array(y) * horizontal, places[:, 2]])
    return np.asarray(projected - origin.array)
