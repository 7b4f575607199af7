"""The base class of all option sections, and the types of options with their units and bounds.

Every number has a lower and an upper bound. A bound is far beyond what is of use, but within what
the arithmetic of the plan can hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import core_schema

from pipeline.runtime.text import is_plain

_MAX_PATH = 4000


class Section(BaseModel):
    """A section of options. Unknown names are errors, and values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Unit:
    """The unit of a number, for the reference pages. Every number has one.

    As pydantic's annotation, it refuses booleans.
    """

    name: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_before_validator_function(_no_boolean, handler(source))


def _no_boolean(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("Input should be a number, not true or false")
    return value


#: The largest number of photographs, frames or views that an option may name.
MAX_PHOTOS = 1_000_000
#: The longest side of an image in pixels. As ``views.max_long_side_px`` it means the full size.
MAX_SIDE_PX = 1_000_000
#: The largest number of Gaussians, points or steps, and the largest factor.
MAX_GAUSSIANS, MAX_STEPS, MAX_FACTOR = 100_000_000, 10_000_000, 1_000_000
#: The largest number of voxels of a mesh (8 bytes each); larger voxels are used if it needs more.
MAX_MESH_VOXELS = 24_000_000


def _plain_path(path: str) -> str:
    if not path or not is_plain(path):
        raise ValueError("Input should be a path in UTF-8 without control characters")
    if len(path) > _MAX_PATH:
        raise ValueError(f"Input should be a path of at most {_MAX_PATH} characters")
    return path


Seed = Annotated[int, Field(ge=0, lt=2**31), Unit("number")]
Count = Annotated[int, Field(gt=0, le=MAX_PHOTOS), Unit("count")]
Pixels = Annotated[int, Field(gt=0, le=MAX_SIDE_PX), Unit("pixels")]
Steps = Annotated[int, Field(gt=0, le=MAX_STEPS), Unit("steps")]
Points = Annotated[int, Field(gt=0, le=MAX_GAUSSIANS), Unit("points")]
GaussianCount = Annotated[int, Field(gt=0, le=MAX_GAUSSIANS), Unit("Gaussians")]
Minutes = Annotated[float, Field(ge=0.001, le=100_000), Unit("minutes")]
SHDegree = Annotated[int, Field(ge=0, le=3), Unit("degree")]
Share = Annotated[float, Field(ge=0.0, le=1.0), Unit("share")]
LossWeight = Annotated[float, Field(ge=0.0, le=MAX_FACTOR), Unit("factor")]
LearningRate = Annotated[float, Field(ge=0.0, le=MAX_FACTOR), Unit("per step")]
SceneShare = Annotated[float, Field(ge=0.0, le=MAX_FACTOR), Unit("scene sizes")]
#: The largest coordinate of a box.
MAX_COORDINATE = 1e9
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE), Unit("scene units")]


def _with_inside(box: tuple[float, ...]) -> tuple[float, ...]:
    if not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise ValueError("Input should be [x0, y0, z0, x1, y1, z1] with x0 < x1, y0 < y1, z0 < z1")
    return box


#: Two corners of a box with sides along the axes: x0, y0, z0, x1, y1, z1.
Box = Annotated[
    tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate],
    AfterValidator(_with_inside),
    Unit("scene units"),
]
FilePath = Annotated[str, AfterValidator(_plain_path)]
