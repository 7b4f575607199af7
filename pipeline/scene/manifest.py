"""The list of a scene's photographs that stages hand to one another (``images.json``)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydantic import BaseModel, ConfigDict, model_validator

from pipeline.runtime.atomic import write_text
from pipeline.runtime.record import read_record


class Photo(BaseModel):
    """One photograph, all facts known without decoding its pixels.

    Sizes and coordinates refer to the stored pixel grid: EXIF orientation is never applied to
    pixels (COLMAP's habit; cv2 must be told), only carried along for pages that show pictures.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    """Relative to the image folder, "/" between folders; unique."""
    path: str
    """File to read, as seen from the working directory."""
    width: int
    height: int
    digest: str
    """Hex digest of the file's bytes (``recorded.digest_of``), which every reader compares."""
    raw: bool = False
    alpha: bool = False
    bits: int = 8
    orientation: int = 1
    """EXIF orientation, 1 to 8."""
    mask: str | None = None
    """Mask file; non-zero pixels count, zero ones are ignored."""
    mask_digest: str | None = None
    depth: str | None = None
    """Depth map file."""
    depth_digest: str | None = None
    focal_px: float | None = None
    """Focal length prior from EXIF in pixels of this size."""
    camera_group: str = ""
    """Photographs with the same group were taken with the same body, lens, focal and size."""
    gps: tuple[float, float, float] | None = None
    """Latitude and longitude in degrees, altitude in metres."""
    taken: str | None = None
    """EXIF time, ISO 8601."""

    @model_validator(mode="after")
    def _files_have_digests(self) -> Photo:
        if bool(self.mask) != bool(self.mask_digest) or bool(self.depth) != bool(self.depth_digest):
            raise ValueError("a mask or depth map and its digest belong together")
        return self


class Manifest(BaseModel):
    """A scene's photographs, sorted by name."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: str
    photos: tuple[Photo, ...]
    warnings: tuple[str, ...] = ()

    def write(self, path: Path) -> None:
        """Files inside the manifest's own folder are written as "./..." from there: the folder
        may be moved as a whole."""
        folder = path.parent

        def inside(file: str) -> str:
            return (
                f"./{Path(file).relative_to(folder)}" if Path(file).is_relative_to(folder) else file
            )

        write_text(path, self._with_files(inside).model_dump_json(indent=1) + "\n")

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
