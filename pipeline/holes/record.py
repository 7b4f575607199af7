"""What was invented in a scene (``holes.json``)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from pipeline.runtime.json_file import JsonFile, JsonObject, Matrix4


class PaintedHoles(JsonObject):
    """A view without a photograph whose holes were painted."""

    world_to_camera: Matrix4 = Field(description="Its pose, in the world of the scene's cameras.")
    width: int = Field(ge=1, description="Pixels.")
    height: int = Field(ge=1, description="Pixels.")
    hole_share: float = Field(
        ge=0, le=1, description="Share of the pixels that no training view sees, before painting."
    )
    before: str | None = Field(
        None, description="File of the render before; null unless the page shows the view."
    )
    mask: str | None = Field(
        None, description="File of the mask, white in painted pixels; null as `before`."
    )
    after: str | None = Field(
        None, description="File of the render with invented Gaussians; null as `before`."
    )


class InventedView(JsonObject):
    """An evaluated view of the scene with invented Gaussians."""

    name: str = Field(description="The photograph's name.")
    invented_share: float = Field(ge=0, le=1, description="Share of invented pixels.")
    mask: str | None = Field(
        description="File of the mask, white in invented pixels; null if there are none."
    )


class InventedSummary(JsonObject):
    """What was invented where no photograph sees the scene. The measures of quality are of the
    scene without it."""

    num_gaussians: int = Field(ge=0, description="Number of invented Gaussians.")
    num_painted_views: int = Field(ge=0, description="Number of views whose holes were painted.")
    mean_share: float = Field(
        ge=0, le=1, description="Mean share of invented pixels in the measured views."
    )
    largest_share: float = Field(
        ge=0, le=1, description="Largest share of invented pixels in a measured view."
    )


class HolesRecord(JsonFile):
    """What was invented where no photograph sees the scene.

    The invented Gaussians are the last ones of `holes/gaussians.npz`, and of each exported file. A
    pixel is invented if they have more than a tenth of its colour.
    """

    file_name: ClassVar[str] = "holes.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    painter: Literal["inpaint", "command"] = Field(description="What painted the holes.")
    num_invented: int = Field(ge=0, description="Number of invented Gaussians.")
    painted: tuple[PaintedHoles, ...] = Field(description="In the order of painting.")
    views: tuple[InventedView, ...] = Field(description="The evaluated views.")

    def summary(self) -> InventedSummary:
        """The part that stands in ``metrics.json``."""
        shares = [view.invented_share for view in self.views]
        return InventedSummary(
            num_gaussians=self.num_invented,
            num_painted_views=len(self.painted),
            mean_share=round(sum(shares) / max(len(shares), 1), 4),
            largest_share=max(shares, default=0.0),
        )


def num_invented(folder: Path | None) -> int:
    """The number of invented Gaussians in the output of the holes stage; 0 if it did not run."""
    return 0 if folder is None else HolesRecord.read(folder).num_invented
