"""World frame of a reconstruction: metres east, north and up from GPS (``gps_frame``) or ground
control points (``gcp_frame``), otherwise level (y down) with unit scale.

Structure from motion determines a model up to a similarity: rotation, translation and scale, seven
parameters. A fit is used only if its covariance shows that scale and heading are determined, and
its up direction does not contradict the photographs'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.geodesy import to_enu
from pipeline.geometry.similarity import RobustFit, Similarity
from pipeline.geometry.up_direction import Contradiction, ImageDirections
from pipeline.io.projection import Projection
from pipeline.scene.georeference import (
    FrameUncertainty,
    GeographicOrigin,
    Georeference,
    Origin,
    Residual,
    ResidualSummary,
)

Array = NDArray[np.float64]
Method = Literal["gcp", "gps", "level"]

MIN_POSITIONS = 3
# Standard deviation of an up direction that is estimated from photographs.
CAMERA_TILT_RAD = float(np.radians(5.0))
# A frame is used if its scale and heading are known at least so well (standard deviations).
MAX_SCALE, MAX_HEADING_RAD = 0.1, float(np.radians(10.0))
# Above this standard deviation of the scale, a warning says how well lengths are known.
WARN_SCALE = 0.02
# Without a georeference the scene is scaled so that this share of the camera centres lies within
# this distance of their mean.
LEVEL_RADIUS, LEVEL_SHARE = 1.0, 0.95


@dataclass(frozen=True)
class Cameras:
    """Registered photographs.

    Attributes:
        names: N names.
        centres: (N, 3) camera centres.
        up: (3,) up direction estimated from the orientations, a unit vector.
        directions: Directions of the photographs; None if nothing is known of their orientations.
    """

    names: list[str]
    centres: Array
    up: Array
    directions: ImageDirections | None = None

    def contradiction(self, similarity: Similarity) -> Contradiction | None:
        """How the up direction of a frame contradicts the photographs; None where it does not."""
        if self.directions is None:
            return None
        return self.directions.contradiction(similarity.rotation[2])


@dataclass(frozen=True)
class WorldFrame:
    """World frame of a model.

    Attributes:
        method: The source of the frame.
        similarity: The transform from the mapper's world to this frame.
        origin: The frame's origin: geographic (GPS, or geographic GCPs), or in ``projection``; None
            for "level".
        projection: The projection of the ground control file; None otherwise.
        residuals: The residual of each photograph (GPS) or point (GCP).
        fit: The fit that the similarity belongs to; None for "level".
        tilt_from: What determines the tilt.
        decisions, warnings: The sentences for the log.
    """

    method: Method
    similarity: Similarity
    origin: Origin | None = None
    projection: Projection | None = None
    residuals: tuple[Residual, ...] = ()
    fit: RobustFit | None = None
    tilt_from: Literal["positions", "cameras"] = "positions"
    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def georeference(self) -> Georeference:
        """The content of ``georeference.json``."""
        located = self.method != "level"
        axes = self.projection.axes if self.projection else ("east", "north")
        return Georeference(
            method=self.method,
            axes=f"x {axes[0]}, y {axes[1]}, z up" if located else "y down; x and z level",
            unit="metres"
            if located
            else f"{LEVEL_SHARE:.0%} of the cameras lie within {LEVEL_RADIUS:g} of their mean",
            origin=self.origin,
            projection=self.projection and self.projection.text,
            projection_units_m=self.projection
            and (None if self.projection.geographic else self.projection.horizontal_vertical),
            scale=self.similarity.scale,
            rotation=self.similarity.rotation.tolist(),
            translation=self.similarity.translation.tolist(),
            residuals_m=self.fit
            and summary(self.residuals, self.fit.observations, self.fit.freedoms),
            uncertainty=self.fit and uncertainty(self.fit, self.tilt_from),
            residuals=self.residuals,
        )


def summary(residuals: Sequence[Residual], observations: int, freedoms: int) -> ResidualSummary:
    """Median and maximum of the used residuals, metres."""
    used = [r for r in residuals if r.used]
    horizontal = np.array([r.horizontal_m for r in used])
    vertical = np.abs([r.vertical_m for r in used if r.vertical_m is not None])
    return ResidualSummary(
        used=len(used),
        left_out=len(residuals) - len(used),
        observations=observations,
        freedoms=freedoms,
        horizontal_median=float(np.median(horizontal)),
        horizontal_max=float(horizontal.max()),
        vertical_median=float(np.median(vertical)) if len(vertical) else None,
        vertical_max=float(vertical.max()) if len(vertical) else None,
    )


def uncertainty(fit: RobustFit, tilt_from: Literal["positions", "cameras"]) -> FrameUncertainty:
    """Standard deviations for the record."""
    scale, heading, tilt = fit.uncertainty
    return FrameUncertainty(
        scale=float(f"{scale:.3g}"),
        heading_deg=float(f"{np.degrees(heading):.3g}"),
        tilt_deg=float(f"{np.degrees(tilt):.3g}"),
        tilt_from=tilt_from,
    )


def fitted_frame(
    found: WorldFrame, what: str, place: str, names: Sequence[str], residual: Array
) -> WorldFrame:
    """A frame with the records of its fit, the sentence about it, and warnings of outliers and of
    an uncertain scale.

    Args:
        found: The frame with its fit, without residuals.
        what: The measurements in words, such as "GPS positions".
        place: What the sentence says of them.
        names: The names of the measured photographs or points.
        residual: (N, 3) residuals; NaN where a height was not measured.
    """
    fit = found.fit
    assert fit is not None
    records = residual_records(names, residual, fit.inliers)
    totals = summary(records, fit.observations, fit.freedoms)
    known = uncertainty(fit, found.tilt_from)
    digits = 3 if found.method == "gcp" else 2
    vertical = ""
    if totals.vertical_median is not None:
        vertical = f", {totals.vertical_median:.{digits}f} m vertical"
    cameras = ", from the cameras" if known.tilt_from == "cameras" else ""
    decision = (
        f"georeferenced by {totals.used} {what}{place} median residual "
        f"{totals.horizontal_median:.{digits}f} m horizontal{vertical} "
        f"({totals.observations} observations, {totals.freedoms} degrees of freedom); standard "
        f"deviations: scale {known.scale:.2g}, heading {known.heading_deg:.2g} degrees, tilt "
        f"{known.tilt_deg:.2g} degrees{cameras}"
    )
    warnings = list(found.warnings)
    if known.scale > WARN_SCALE:
        warnings.append(
            f"the {what} determine the scale to {known.scale:.0%} only (standard deviation): "
            "lengths in metres are as inaccurate"
        )
    return replace(found, residuals=records, decisions=[decision], warnings=warnings)


def local_frame(geodetic: Array) -> tuple[Array, GeographicOrigin]:
    """(N, 3) metres east, north and up of the median position, and that position.

    Args:
        geodetic: (N, 3) latitudes and longitudes in degrees, heights in metres; NaN for unknown
            heights, which are at the median height.
    """
    geodetic = geodetic.copy()
    # Longitudes relative to the first: the scene may span the date line.
    geodetic[:, 1] = geodetic[0, 1] + (geodetic[:, 1] - geodetic[0, 1] + 180) % 360 - 180
    measured = np.isfinite(geodetic[:, 2])
    altitude = float(np.median(geodetic[measured, 2])) if measured.any() else None
    geodetic[~measured, 2] = altitude or 0.0
    origin = np.median(geodetic, axis=0)
    latitude, longitude = float(origin[0]), (float(origin[1]) + 180) % 360 - 180
    place = GeographicOrigin(latitude=latitude, longitude=longitude, altitude=altitude)
    return to_enu(geodetic, origin), place


def undetermined(fit: RobustFit) -> str | None:
    """Why a fit is not used: its measurements contradict each other or determine too little."""
    used, count = int(fit.inliers.sum()), len(fit.inliers)
    if used < MIN_POSITIONS or 2 * used <= count:
        return f"at most {used} of {count} agree with each other"
    scale, heading, _ = fit.uncertainty
    if fit.freedoms < 1 or scale > MAX_SCALE or heading > MAX_HEADING_RAD:
        return (
            f"{used} with an error of about {fit.sigma:.2g} m determine the scale to "
            f"{min(scale, 9.99):.0%} and the heading to {min(np.degrees(heading), 180.0):.0f} "
            f"degrees only ({fit.observations} observations, {max(fit.freedoms, 0)} degrees of "
            "freedom)"
        )
    return None


def level(cameras: Cameras) -> WorldFrame:
    """Level frame: y down, origin at the mean camera centre, scaled to ``LEVEL_RADIUS``."""
    mean = cameras.centres.mean(0)
    distances = np.linalg.norm(cameras.centres - mean, axis=1)
    size = float(np.quantile(distances, LEVEL_SHARE, method="higher"))
    scale = LEVEL_RADIUS / size if size > 1e-12 else 1.0
    rotation = rotation_between(cameras.up, np.array([0.0, -1.0, 0.0]))
    return WorldFrame(
        "level",
        Similarity(scale, rotation, -scale * rotation @ mean),
        decisions=[
            "no georeference: the scene is level (y down) and scaled by the extent of its cameras"
        ],
    )


def residual_records(
    names: Sequence[str], residual: Array, used: NDArray[np.bool_]
) -> tuple[Residual, ...]:
    """Records of (N, 3) residuals; NaN where a height was not measured."""
    return tuple(
        Residual(
            name=name,
            horizontal_m=round(float(np.hypot(r[0], r[1])), 4),
            vertical_m=round(float(r[2]), 4) if np.isfinite(r[2]) else None,
            used=bool(inlier),
            x_m=round(float(r[0]), 4),
            y_m=round(float(r[1]), 4),
        )
        for name, r, inlier in zip(names, residual, used, strict=True)
    )


def rotation_between(source: Array, target: Array) -> Array:
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
