"""World frame from ground control points, and what a wrong frame is caused by.

Coordinates in another order, with another sign or in another unit fit a model worse than correct
ones, or turn it upside down; three points or points on a plane fit as well when they are mirrored,
so that only the orientation of the photographs shows it. Each likely mistake is undone and fitted
again: a mistake that explains the misfit is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.similarity import (
    OUTLIER_SIGMAS,
    Noise,
    RobustFit,
    median_distance,
    robust_similarity,
)
from pipeline.io.gcp import GCP_FILE, GroundControl
from pipeline.runtime.errors import UserError
from pipeline.runtime.text import shortened
from pipeline.scene.georeference import CartesianOrigin, Origin
from pipeline.sfm.georeference import (
    MIN_POSITIONS,
    Cameras,
    WorldFrame,
    fitted_frame,
    local_frame,
    undetermined,
)

Array = NDArray[np.float64]
Pixels = Mapping[str, tuple[float, float]]


class Triangulated(NamedTuple):
    """A point seen in photographs: its position (3,) in the mapper's world, and the size of a pixel
    at it."""

    position: Array
    pixel: float


# Errors of surveyed points, metres, and of their positions in photographs, pixels.
SURVEY_SIGMA_M, MARK_SIGMA_PX = 0.03, 1.5
# Largest standard deviation of the tilt, radians.
MAX_TILT_RAD = float(np.radians(5.0))
# A mistake explains a misfit if undoing it reduces the residuals by this factor.
EXPLAINS = 3.0
FOOT_M = 0.3048
_ON_A_LINE = "the ground control points lie on a line"


def from_gcp(
    control: GroundControl,
    triangulate: Callable[[Pixels], Triangulated | None],
    cameras: Cameras,
    path: Path = Path(GCP_FILE),
) -> WorldFrame | str:
    """Frame of the ground control points, or the reason why there is none.

    Args:
        triangulate: Returns the point in the mapper's world that photographs (name -> pixel) see;
            None if it cannot be triangulated.
        cameras: The cameras, whose orientations show whether the frame is upside down.
        path: The file, for messages.

    Raises:
        UserError: the coordinates are in another order or unit than the projection's, or mirrored.
    """
    found = [(point, triangulate(point.pixels)) for point in control.points]
    placed = [(point, at) for point, at in found if at is not None]
    if len(placed) < MIN_POSITIONS:
        return (
            f"only {len(placed)} of {len(control.points)} ground control points are seen by two "
            f"photographs with a pose; {MIN_POSITIONS} are needed"
        )
    places = np.array([point.position for point, _ in placed], np.float64)
    source = np.array([at.position for _, at in placed])
    pixel = float(np.median([at.pixel for _, at in placed]))
    target, origin = _local(control, places)
    noise = _noise(source, target, pixel)
    fit = robust_similarity(source, target, np.ones(3), noise)
    if fit is None:
        return _ON_A_LINE
    fit = robust_similarity(source, target, np.ones(3), _noise(source, target, pixel, fit)) or fit
    # Expect the errors that such measurements usually have; those of a mistake are larger.
    usual = min(1.0, noise.sigma / max(fit.sigma, 1e-300))
    if fit.uncertainty.tilt * usual > MAX_TILT_RAD:
        return _line_text(fit)
    contradiction = cameras.contradiction(fit.similarity)
    mistake, also = _mistake(control, places, source, pixel, cameras, (fit, contradiction))
    if mistake is None and contradiction == "upside down":
        mistake = _UPSIDE_DOWN
    if mistake is not None:
        raise UserError(
            f"{mistake.found}{mistake.evidence and f': {mistake.evidence}'}",
            file=path,
            fix=f"{mistake.fix}, or set sfm.georeference: gps or none",
        )
    if (reason := undetermined(fit)) is not None:
        return f"of the ground control points, {reason}"
    if fit.uncertainty.tilt > MAX_TILT_RAD:
        return _line_text(fit)
    names = [point.name for point, _ in placed]
    warnings = []
    if contradiction is not None:
        warnings.append(
            "in the frame of the ground control points the photographs are "
            f"{contradiction}: check the coordinates"
        )
    if outliers := [shortened(names[i], 40) for i in np.flatnonzero(~fit.inliers)]:
        warnings.append(
            f"{len(outliers)} ground control points are outliers and are left out: "
            f"{', '.join(outliers[:5])}"
        )
    if also and contradiction is None:
        warnings.append(
            f"the ground control points would fit as well if {also}: "
            "check the coordinates, or measure further points"
        )
    frame = WorldFrame(
        "gcp", fit.similarity, origin, control.projection, fit=fit, warnings=warnings
    )
    place = f" ({shortened(control.projection.text)}):"
    residual = fit.similarity(source) - target
    frame = fitted_frame(frame, "ground control points", place, names, residual)
    frame.warnings.extend(control.warnings)
    return frame


def _line_text(fit: RobustFit) -> str:
    tilt = min(np.degrees(fit.uncertainty.tilt), 180.0)
    return f"{_ON_A_LINE}: they determine the tilt about it to {tilt:.0f} degrees only"


def _local(control: GroundControl, places: Array) -> tuple[Array, Origin]:
    """(N, 3) metres around an origin, and the origin."""
    if control.geographic:
        return local_frame(places[:, [1, 0, 2]])
    # Whole metres: adding the origin to coordinates is exact.
    origin = np.round(np.median(places, axis=0))
    x, y, z = origin.tolist()
    return places - origin, CartesianOrigin(x=x, y=y, z=z)


def _noise(source: Array, target: Array, pixel: float, fit: RobustFit | None = None) -> Noise:
    """The expected errors, metres. Without a fit, the scale is that of the median distances."""
    scale = median_distance(target) / max(median_distance(source), 1e-300)
    if fit is not None:
        scale = fit.similarity.scale
    return Noise(float(np.hypot(SURVEY_SIGMA_M, MARK_SIGMA_PX * pixel * scale)))


# --- likely mistakes ----------------------------------------------------------------------


class _Mistake(NamedTuple):
    """A likely mistake: what is found, the evidence, and what to do."""

    found: str
    evidence: str
    fix: str


_UPSIDE_DOWN = _Mistake(
    "the photographs would be upside down in the frame of the ground control points",
    "",
    "check the order and the signs of the coordinates",
)


def _mistake(
    control: GroundControl,
    places: Array,
    source: Array,
    pixel: float,
    cameras: Cameras,
    given: tuple[RobustFit, str | None],
) -> tuple[_Mistake | None, str]:
    """The mistake that explains a bad fit or photographs that are upside down; None if none does.
    And the first mistake, empty without one, after which the points would fit as well and the
    photographs would be upright: a triangle is congruent to its mirror image.

    Args:
        given: The fit of the coordinates as they are, and its contradiction.
    """
    fit, contradiction = given
    target = _local(control, places)[0]
    first = np.linalg.norm(fit.similarity(source) - target, axis=1)
    best: tuple[tuple[bool, float, int], _Mistake] | None = None
    also = ""
    for number, (undone, what, fix) in enumerate(_undone(control, places)):
        other_target = _local(control, undone)[0]
        noise = _noise(source, other_target, pixel, fit)
        other = robust_similarity(source, other_target, np.ones(3), noise)
        if other is None or undetermined(other) is not None:
            continue
        other_contradiction = cameras.contradiction(other.similarity)
        second = np.linalg.norm(other.similarity(source) - other_target, axis=1)
        before, after = _misfits(first, second, other.sigma)
        explains = (
            int(other.inliers.sum()) >= max(4, int(fit.inliers.sum()))
            and other.freedoms > 2
            and before > EXPLAINS * after
            and before > EXPLAINS * noise.sigma / 2
        )
        fits = other_contradiction is None and after <= max(2 * before, 3 * noise.sigma)
        turns = contradiction == "upside down" and fits
        # The unit or the sign of z does not show on flat ground. A fit to fewer points is no rival.
        rival = fits and int(other.inliers.sum()) >= int(fit.inliers.sum())
        if rival and not also and (undone[:, :2] != places[:, :2]).any():
            also = what.replace("seem to be", "were").replace("seem to have", "had")
        if not (turns or (explains and other_contradiction != "upside down")):
            continue
        evidence = (
            f"as written, the points fit the photographs to {before:.3g} m, otherwise to "
            f"{after:.3g} m"
        )
        if turns:
            evidence = "as written, the photographs are upside down; " + evidence
        rank = (other_contradiction is not None, round(float(np.log2(after + 1e-9)), 0), number)
        if best is None or rank < best[0]:
            best = rank, _Mistake(what, evidence, fix)
    if best is not None:
        return best[1], also
    left_out = int((~fit.inliers).sum())
    if left_out and len(places) > MIN_POSITIONS and np.ptp(places[:, 2]) == 0:
        return _Mistake(
            f"all {len(places)} points have the height {places[0, 2]:g}",
            f"{left_out} of them do not have it in the photographs",
            "write the measured heights",
        ), also
    return None, also


def _misfits(first: Array, second: Array, sigma: float) -> tuple[float, float]:
    """Root mean squares of two fits' residuals; both without as many of the largest ones as the
    second has outliers."""
    kept = max(int((second <= OUTLIER_SIGMAS * sigma).sum()), MIN_POSITIONS)
    squares = [np.sort(residuals)[:kept] ** 2 for residuals in (first, second)]
    return float(np.sqrt(squares[0].mean())), float(np.sqrt(squares[1].mean()))


def _undone(control: GroundControl, places: Array) -> Iterator[tuple[Array, str, str]]:
    """Coordinates with a likely mistake undone, the mistake, and what to do; likely ones first."""
    projection = control.projection
    swapped = places[:, [1, 0, 2]]
    if projection.geographic:
        if (np.abs(swapped[:, 1]) <= 90).all():
            what = "the coordinates seem to be in the order latitude, longitude"
            yield swapped, what, "exchange the first two columns"
    else:
        yield (
            swapped,
            "the coordinates seem to be in the order northing, easting (or one of the two is "
            "counted in the opposite direction)",
            "exchange the first two columns",
        )
    yield places * [1, 1, -1], "z seems to be counted downwards", "change the sign of z"
    in_feet = places * [1, 1, FOOT_M]
    yield in_feet, "z seems to be in feet", "convert z to metres"
    if projection.vertical != 1.0:
        as_metres = places / [1, 1, projection.vertical]
        fix = "convert z, or write a projection with heights in metres (EPSG:n+5703)"
        yield as_metres, f"z seems to be in metres, not in {projection.unit} units", fix
    if projection.geographic:
        yield places * [-1, 1, 1], "longitudes seem to have the wrong sign", "change their sign"
        yield places * [1, -1, 1], "latitudes seem to have the wrong sign", "change their sign"
