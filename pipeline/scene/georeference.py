"""The world frame of the poses (``georeference.json``): where it lies on the earth or in the given
world, and how well that is known."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipeline.runtime.json_file import JsonFile, JsonObject, Matrix3, Vector3
from pipeline.scene.normalization import IDENTITY, Normalization

GIVEN_UNIT = "that of the given camera poses"
Method = Literal["gcp", "gps", "level", "given"]

METHODS = (
    "gcp: ground control points; gps: EXIF positions; level: none, levelled by the cameras; given: "
    "given poses, translated or scaled."
)


class GeographicOrigin(JsonObject):
    """An origin on the WGS84 ellipsoid."""

    latitude: float = Field(description="Degrees north.")
    longitude: float = Field(description="Degrees east.")
    altitude: float | None = Field(
        description="Metres, as measured: not reduced to a geoid. null if no altitude is known; "
        "heights are then relative to the median camera."
    )


class CartesianOrigin(JsonObject):
    """An origin in the projection of the ground control points, in metres whatever the projection's
    unit is, or in the world and unit of the given poses."""

    x: float = Field(description="East in a projection.")
    y: float = Field(description="North in a projection.")
    z: float = Field(description="Up in a projection.")

    @property
    def array(self) -> NDArray[np.float64]:
        """(3,)."""
        return np.array([self.x, self.y, self.z])


Origin = GeographicOrigin | CartesianOrigin


class Residual(JsonObject):
    """The residual of a photograph's GPS position or of a ground control point after the fit."""

    name: str = Field(description="Of the photograph or the point.")
    horizontal_m: float = Field(description="Distance in the plane of x and y, metres.")
    vertical_m: float | None = Field(
        description="Model minus measurement along z, metres; null without a measured altitude."
    )
    used: bool = Field(description="Whether it is an inlier, which the fit uses.")
    x_m: float | None = Field(
        None, description="Model minus measurement along x, metres; null in older files."
    )
    y_m: float | None = Field(None, description="As `x_m`, along y.")


class ResidualSummary(JsonObject):
    """Residuals of the inliers."""

    used: int = Field(ge=1, description="Number of inliers.")
    left_out: int = Field(ge=0, description="Number of outliers.")
    observations: int = Field(ge=1, description="Number of measured coordinates of the inliers.")
    freedoms: int = Field(
        ge=0,
        description="Degrees of freedom: `observations` less the number of fitted parameters. With "
        "few, residuals are small whatever the errors are.",
    )
    horizontal_median: float = Field(description="Metres.")
    horizontal_max: float = Field(description="Metres.")
    vertical_median: float | None = Field(
        description="Of the absolute values, metres; null without measured altitudes."
    )
    vertical_max: float | None = Field(description="As `vertical_median`.")


class FrameUncertainty(JsonObject):
    """Standard deviations of a georeferenced frame, from the covariance of the fit and the errors
    that such measurements usually have."""

    scale: float = Field(ge=0, description="Relative to the scale.")
    heading_deg: float = Field(ge=0, description="Rotation about the vertical axis, degrees.")
    tilt_deg: float = Field(ge=0, description="Rotation about a horizontal axis, degrees.")
    tilt_from: Literal["positions", "cameras"] = Field(
        description="positions: from the fit. cameras: the positions do not determine the tilt, "
        "and it is estimated from the orientation of the photographs; `tilt_deg` is then a usual "
        "value."
    )


class GeoreferenceSummary(JsonObject):
    """Source, origin and residuals of the world frame."""

    method: Method = Field(description=METHODS)
    origin: Origin | None = Field(
        description="Where the frame's origin is; null for a level frame."
    )
    residuals_m: ResidualSummary | None = Field(
        description="null where nothing was measured: level frames, given poses."
    )
    uncertainty: FrameUncertainty | None = Field(None, description="As `residuals_m`.")


class Georeference(JsonFile, GeoreferenceSummary):
    """The world frame of the poses, and the similarity that leads to it."""

    file_name: ClassVar[str] = "georeference.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    axes: str = Field(description="Directions of the axes.")
    unit: str = Field(description="Unit of length.")
    projection: str | None = Field(
        description="First line of `gcp_list.txt`; null without ground control points."
    )
    projection_units_m: tuple[float, float] | None = Field(
        None,
        description="Metres per unit of the projection, for x and y and for z: coordinates in the "
        "projection are (origin + x) / unit. null where the frame is not in a projection.",
    )
    scale: float = Field(
        gt=0,
        description="A point x in the world of the mapper, or of the given poses, is at "
        "scale * rotation @ x + translation.",
    )
    rotation: Matrix3 = Field(description="3 x 3, by rows.")
    translation: Vector3 = Field(description="In the unit of the frame.")
    residuals: tuple[Residual, ...] = Field(description="Of each photograph or point.")

    @property
    def is_metric(self) -> bool:
        """Whether the unit is the metre."""
        return self.method in ("gcp", "gps")

    @property
    def up(self) -> NDArray[np.float64] | None:
        """(3,) the unit vector upwards; None for given poses, whose world may have any."""
        if self.method == "given":
            return None
        return np.array([0.0, -1.0, 0.0] if self.method == "level" else [0.0, 0.0, 1.0])

    @property
    def normalization(self) -> Normalization:
        """From the given world to the scene's; the identity unless ``method`` is "given"."""
        if self.method != "given" or not isinstance(self.origin, CartesianOrigin):
            return IDENTITY
        return Normalization(self.scale, self.origin.array)

    @property
    def projected_origin(self) -> NDArray[np.float64] | None:
        """(3,) the frame's origin in the projection of the ground control points, metres; None for
        other frames."""
        if self.method != "gcp" or not isinstance(self.origin, CartesianOrigin):
            return None
        return self.origin.array

    def from_projection(self, xyz: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """(N, 3) coordinates in the projection of the ground control points, in its units, to the
        frame; None for other frames."""
        origin = self.projected_origin
        if origin is None:
            return None
        horizontal, vertical = self.projection_units_m or (1.0, 1.0)
        return np.asarray(xyz * [horizontal, horizontal, vertical] - origin)

    def in_given_unit(self) -> Georeference | None:
        """Of exported Gaussians: the given poses' unit, the scene's origin. None if that is the
        given world."""
        origin = self.normalization.origin
        if not origin.any():
            return None
        update = {"unit": GIVEN_UNIT, "scale": 1.0, "translation": tuple((-origin).tolist())}
        return self.model_copy(update=update)

    @classmethod
    def normalization_of(cls, folder: Path) -> Normalization:
        """``normalization`` of the file in ``folder``; the identity without a file."""
        return cls.read(folder).normalization if (folder / cls.file_name).is_file() else IDENTITY

    def summary(self) -> GeoreferenceSummary:
        fields = GeoreferenceSummary.model_fields
        return GeoreferenceSummary(**{name: getattr(self, name) for name in fields})
