"""The pairs of photographs to match, in a file of their own where several jobs match them."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from pipeline.runtime.json_file import JsonFile


class PairList(JsonFile):
    """The pairs of photographs to match."""

    file_name: ClassVar[str] = "pairs.json"

    pairs: list[tuple[int, int]] = Field(
        description="Positions of the two photographs, from 0, in the order of names; sorted."
    )
    focals: dict[int, float] = Field(
        description="Id of a fisheye camera without a prior to its initial focal length, pixels."
    )
    decisions: list[str] = Field(description="How the pairs and focal lengths were chosen.")
