"""The list of a scene's photographs and videos that stages exchange (``images.json``)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, model_validator

from pipeline.runtime.atomic import write_text
from pipeline.runtime.record import read_record


class Photo(BaseModel):
    """A photograph and its metadata, read without decoding pixels.

    Sizes and coordinates refer to the stored pixels. As in COLMAP, the orientation that EXIF or
    TIFF gives is not applied to them (``pipeline.io.pictures`` decodes all files); it decides how
    the report displays photographs and where up is.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    name: str
    """Relative to the image folder, "/" between folders; unique."""
    path: str
    """The file, relative to the working directory or absolute."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    digest: str
    """Hex digest of the file's bytes (``pipeline.io.recorded``), checked whenever it is read."""
    linear: bool = False
    """Whether the file is of linear light (RAW, EXR), which the decode stage develops."""
    alpha: bool = False
    """Whether any pixel is transparent."""
    bits: int = 8
    """Bits per channel of the file."""
    orientation: int = 1
    """EXIF orientation, 1 to 8."""
    colours: str = ""
    """Name of the colour space that is converted to sRGB when the file is decoded; empty for sRGB,
    and for files that name none."""
    mask: str | None = None
    """Mask file; pixels that are dark or transparent in it are ignored (``pipeline.io.masks``)."""
    mask_digest: str | None = None
    """As ``digest``, of the mask."""
    depth: str | None = None
    """Depth map file; see ``pipeline.photos.load`` for its formats."""
    depth_digest: str | None = None
    """As ``digest``, of the depth map."""
    focal_px: float | None = None
    """Focal length from EXIF, in pixels at ``width`` x ``height``."""
    camera_group: str = ""
    """Equal for photographs with the same camera body, lens, focal length and size."""
    panorama: bool = False
    """Whether it is an equirectangular panorama of 360 by 180 degrees."""
    source: str | None = None
    """Name of the photograph of which this is a part; null for a whole photograph."""
    gps: tuple[float, float, float | None] | None = None
    """Latitude and longitude in degrees, altitude in metres; null for an unknown altitude."""
    taken: str | None = None
    """Time of exposure from EXIF, ISO 8601."""
    split: Literal["train", "test"] | None = None
    """Its part of the scene's own split, or of the choice of ``split.train_views``; null for scenes
    with neither."""

    @model_validator(mode="after")
    def _files_have_digests(self) -> Photo:
        if bool(self.mask) != bool(self.mask_digest) or bool(self.depth) != bool(self.depth_digest):
            raise ValueError("a mask or depth map and its digest belong together")
        return self


class VideoFile(BaseModel):
    """A video, of which the decode stage makes photographs."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    name: str
    """The folder of its frames in the names of photographs; unique."""
    path: str
    """The file, relative to the working directory or absolute."""
    width: int
    """Pixels, with the rotation and the pixel aspect ratio of the header applied."""
    height: int
    """As ``width``."""
    frames: int
    """Number of frames according to the header, which may be wrong; 0 if unknown."""
    fps: float
    """Frames per second according to the header; 0 if unknown."""
    digest: str
    """Hex digest of the file's bytes."""
    counted: bool = False
    """Whether ``frames`` is the number of stored frames and not estimated from the length."""
    truncated: bool = False
    """Whether the file is shorter than its header says."""
    others: tuple[tuple[int, int], ...] = ()
    """Width and height of the video streams of the file that are not used."""
    alike: int = 1
    """Number of streams of the same size as the one that is used, with it."""

    @property
    def camera_group(self) -> str:
        """That of the frames (``Photo.camera_group``)."""
        return f"{self.name} {self.width}x{self.height}"

    def frame_name(self, index: int) -> str:
        """The name of the photograph made of a frame (numbered from 0), in the order of frames."""
        return f"{self.name}/{index:06d}.png"


class Manifest(BaseModel):
    """A scene's photographs, sorted by name, and the videos that are not decoded yet."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    scene: str
    """The run's name: a scene, alone or with configuration and seed."""
    photos: tuple[Photo, ...]
    """The photographs that are used."""
    videos: tuple[VideoFile, ...] = ()
    """The videos that are not decoded yet."""
    warnings: tuple[str, ...] = ()
    """What the user should know."""

    def write(self, path: Path) -> None:
        """Write ``path``. Paths of files below its folder become relative to it ("./..."), so that
        the folder can be moved."""
        folder = path.parent

        def inside(file: str) -> str:
            return (
                f"./{Path(file).relative_to(folder)}" if Path(file).is_relative_to(folder) else file
            )

        write_text(path, self._with_files(inside).model_dump_json(indent=1) + "\n")

    def only(self, names: Collection[str]) -> Manifest:
        """The manifest with these photographs alone."""
        photos = tuple(photo for photo in self.photos if photo.name in names)
        return self.model_copy(update={"photos": photos})

    @staticmethod
    def read(path: Path) -> Manifest:
        """Raises: UserError: the file is missing or damaged."""

        def resolved(file: str) -> str:
            return str(path.parent / file) if file.startswith("./") else file

        return read_record(path, Manifest)._with_files(resolved)

    def _with_files(self, change: Callable[[str], str]) -> Manifest:
        photos = [
            photo.model_copy(
                update={
                    "path": change(photo.path),
                    "mask": photo.mask and change(photo.mask),
                    "depth": photo.depth and change(photo.depth),
                }
            )
            for photo in self.photos
        ]
        return self.model_copy(update={"photos": tuple(photos)})
