"""The base class of all option sections, and the types of options with their units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class Section(BaseModel):
    """A section of options: unknown names are errors, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Unit:
    """The unit of a number, for the reference pages."""

    name: str


Seed = Annotated[int, Field(ge=0, lt=2**31), Unit("number")]
Count = Annotated[int, Field(gt=0), Unit("count")]
Pixels = Annotated[int, Field(gt=0), Unit("pixels")]
Steps = Annotated[int, Field(gt=0), Unit("steps")]
Minutes = Annotated[float, Field(gt=0), Unit("minutes")]
Share = Annotated[float, Field(ge=0.0, le=1.0), Unit("share")]
LossWeight = Annotated[float, Field(ge=0.0), Unit("factor")]
LearningRate = Annotated[float, Field(ge=0.0), Unit("per step")]
SceneShare = Annotated[float, Field(ge=0.0), Unit("scene sizes")]
