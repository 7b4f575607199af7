"""The base class of all option sections, and the types of options with their units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import core_schema


class Section(BaseModel):
    """A section of options: unknown names are errors, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Unit:
    """The unit of a number, for the reference pages. Every number has one.

    As pydantic's annotation, it refuses booleans, and numbers out of the range of 32 bits.
    """

    name: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_before_validator_function(_not_wild, handler(source))


def _not_wild(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("Input should be a number, not true or false")
    if isinstance(value, int | float) and abs(value) > 2**31:
        raise ValueError("Input should be a number between -2147483648 and 2147483648")
    return value


Seed = Annotated[int, Field(ge=0, lt=2**31), Unit("number")]
Count = Annotated[int, Field(gt=0), Unit("count")]
Pixels = Annotated[int, Field(gt=0), Unit("pixels")]
Steps = Annotated[int, Field(gt=0), Unit("steps")]
Minutes = Annotated[float, Field(gt=0), Unit("minutes")]
Share = Annotated[float, Field(ge=0.0, le=1.0), Unit("share")]
LossWeight = Annotated[float, Field(ge=0.0), Unit("factor")]
LearningRate = Annotated[float, Field(ge=0.0), Unit("per step")]
SceneShare = Annotated[float, Field(ge=0.0), Unit("scene sizes")]
