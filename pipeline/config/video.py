"""Options of the exported video."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from pipeline.config.section import Section, Unit


def _even(side: int) -> int:
    if side % 2:
        raise ValueError("Input should be even: video encoders halve the resolution of colours")
    return side


class VideoExport(Section):
    """The video of the format `video`, rendered along a camera path."""

    path: Literal["auto", "orbit", "cameras"] = Field(
        "auto",
        description="orbit: around the subject, a full circle if the photographs surround it, else "
        "back and forth over the angles that they cover. cameras: through the cameras in the order "
        "of the photographs' names. auto: orbit if most photographs show a common subject.",
    )
    seconds: Annotated[float, Field(ge=1, le=600), Unit("seconds")] = Field(
        8.0, description="Duration."
    )
    fps: Annotated[int, Field(ge=1, le=120), Unit("frames per second")] = Field(
        30, description="Frame rate."
    )
    long_side_px: (
        Annotated[int, Field(ge=16, le=8192), AfterValidator(_even), Unit("pixels")] | None
    ) = Field(
        None,
        description="Longer side of a frame. null: as the training views "
        "(`views.max_long_side_px`), whose details are all that the scene has.",
    )

    @property
    def num_frames(self) -> int:
        """The number of frames."""
        return round(self.seconds * self.fps)
