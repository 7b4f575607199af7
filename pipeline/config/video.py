"""Options of the exported video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from pipeline.config.section import FilePath, Section, Unit

_SUFFIX = ".json"


def _even(side: int) -> int:
    if side % 2:
        raise ValueError("Input should be even: video encoders halve the resolution of colours")
    return side


def _path_file(name: str) -> str:
    if not name.lower().endswith(_SUFFIX):
        raise ValueError(f"Input should be a file of a camera path ({_SUFFIX})")
    return name


PathFileName = Annotated[FilePath, AfterValidator(_path_file)]
PhotoNames = Annotated[
    tuple[Annotated[str, Field(min_length=1, max_length=1000)], ...],
    Field(min_length=2, max_length=1000),
]


class VideoExport(Section):
    """The video of the format `video`, rendered along a camera path."""

    path: Literal["auto", "orbit", "cameras"] | PathFileName | PhotoNames = Field(
        "auto",
        description="orbit: around the subject, a full circle if the photographs surround it, else "
        "back and forth over the angles that they cover. cameras: through the cameras in the order "
        "of the photographs' names. auto: orbit if most photographs show a common subject. A list "
        "of photographs' names: a spline through their cameras, closed if the first is also the "
        "last. A file (.json, relative to the folder that holds results/): the cameras of an "
        "earlier video's path.json, of nerfstudio's camera_path.json or of splat-transform's list "
        "of frames.",
    )
    seconds: Annotated[float, Field(ge=1, le=600), Unit("seconds")] = Field(
        8.0, description="Duration, unless `path` is a file: then each of its cameras is a frame."
    )
    fps: Annotated[int, Field(ge=1, le=120), Unit("frames per second")] = Field(
        30, description="Frame rate, unless the file of `path` has its own."
    )
    long_side_px: (
        Annotated[int, Field(ge=16, le=8192), AfterValidator(_even), Unit("pixels")] | None
    ) = Field(
        None,
        description="Longer side of a frame. null: as the file of `path` says, else as the "
        "training views (`views.max_long_side_px`), whose details are all that the scene has.",
    )

    @property
    def path_file(self) -> Path | None:
        """The file with the cameras."""
        named = isinstance(self.path, str) and self.path.lower().endswith(_SUFFIX)
        return Path(str(self.path)) if named else None

    @property
    def num_frames(self) -> int:
        """The number of frames of a path that is no file."""
        return round(self.seconds * self.fps)
