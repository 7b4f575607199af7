"""Camera paths of videos: splatmake's ``path.json``, nerfstudio's ``camera_path.json`` and the list
of frames that splat-transform renders."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.io.bounded import read_text
from pipeline.io.poses.frames import checked_pose
from pipeline.io.poses.matrices import pose_matrix
from pipeline.runtime.errors import UserError
from pipeline.runtime.json_file import JsonFile, JsonObject, Matrix4, first_error

Array = NDArray[np.float64]

#: The most frames of a path: ten minutes at 120 frames per second.
MAX_FRAMES = 72_000
_MAX_BYTES = 64 << 20
_FIX = "see docs/reference/formats.md for the files of camera paths"
_OPENGL = np.diag([1.0, -1.0, -1.0])
#: splat-transform turns files of Gaussians by 180 degrees about z.
_PLAYCANVAS = np.diag([-1.0, -1.0, 1.0])
#: splat-transform's default field of view, degrees.
_DEFAULT_FOV = 60.0
#: The least sine of the angle between the viewing direction and up that determines the roll.
_LEAST_SINE = 1e-4

_Side = Annotated[int, Field(ge=2, le=8192)]
_Fps = Annotated[float, Field(ge=1, le=120)]
_Fov = Annotated[float, Field(ge=0.1, le=179)]
_Focal = Annotated[float, Field(gt=0, le=1e7)]


class PathFile(JsonFile, JsonObject):
    """The camera path of the video: a pinhole camera for each frame."""

    file_name: ClassVar[str] = "path.json"

    schema_version: Literal[1] = Field(1, description="Version of this file's format.")
    convention: str = Field(description="Of the poses; sentences for people.")
    fps: int = Field(gt=0, le=120, description="Frames per second.")
    width: _Side = Field(description="Of a frame, pixels.")
    height: _Side = Field(description="Of a frame, pixels.")
    fx: _Focal = Field(description="Focal length along x, pixels.")
    fy: _Focal = Field(description="Focal length along y, pixels.")
    cx: float = Field(description="Principal point, pixels.")
    cy: float = Field(description="Principal point, pixels.")
    focal_factors: tuple[_Focal, ...] | None = Field(
        None,
        description="Factors of `fx` and `fy` of each frame, of a path that zooms; null for 1.",
    )
    world_to_camera: Annotated[tuple[Matrix4, ...], Field(max_length=MAX_FRAMES)] = Field(
        description="4 x 4 by rows, of each frame; unit and frame of the exported Gaussians."
    )


@dataclass(frozen=True)
class CameraPath:
    """A camera for each frame of a video.

    Attributes:
        world_to_camera: (N, 4, 4), COLMAP's convention.
        focal: (N,) focal lengths as shares of the height of a frame.
        size: The width and height of a frame, pixels; None if the file leaves them open.
        fps: Frames per second; None if the file leaves it open.
        world: The world of the poses: that of the exported Gaussians, or that of the exported
            cameras (``transforms.json``), whose origin may differ.
        label: The kind of file.
    """

    world_to_camera: Array
    focal: Array
    size: tuple[int, int] | None
    fps: int | None
    world: Literal["gaussians", "cameras"]
    label: str


class _Part(BaseModel):
    """A part of a file of another program, which may have further fields."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class _NerfstudioCamera(_Part):
    camera_to_world: list[float]
    fov: _Fov


class _Nerfstudio(_Part):
    """Cameras in OpenGL's convention, by rows, with vertical fields of view in degrees."""

    camera_type: Literal["perspective"] = "perspective"
    render_height: _Side
    render_width: _Side
    fps: _Fps | None = None
    camera_path: Annotated[tuple[_NerfstudioCamera, ...], Field(max_length=MAX_FRAMES)]


_Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
_Vector = tuple[_Coordinate, _Coordinate, _Coordinate]


class _Frame(_Part):
    position: _Vector
    target: _Vector
    fov: _Fov = _DEFAULT_FOV
    up: _Vector = (0.0, 1.0, 0.0)


class _Frames(_Part):
    """Cameras by position and target, in PlayCanvas's axes."""

    frameRate: _Fps | None = None
    frames: Annotated[tuple[_Frame, ...], Field(max_length=MAX_FRAMES)]


def read_camera_path(path: Path) -> CameraPath:
    """Read a camera path.

    Raises:
        UserError: The file cannot be read, is no camera path, has fewer than two cameras, or a
            matrix that is no pose.
    """
    try:
        content = json.loads(read_text(path, _MAX_BYTES, fix=_FIX))
    except (ValueError, RecursionError):
        _refuse(path, "expected JSON")
    for key, model, convert in _KINDS:
        if isinstance(content, dict) and key in content:
            try:
                found = convert(path, model.model_validate(content))
            except ValidationError as error:
                _refuse(path, first_error(error))
            if len(found.world_to_camera) < 2:
                _refuse(path, "expected a path of at least two cameras")
            return found
    _refuse(path, f"expected an object with one of {', '.join(key for key, *_ in _KINDS)}")


def _refuse(path: Path, what: str) -> NoReturn:
    raise UserError(what, file=path, fix=_FIX) from None


def _of_path_file(path: Path, content: PathFile) -> CameraPath:
    poses, factors = np.array(content.world_to_camera).reshape(-1, 4, 4), content.focal_factors
    if factors is not None and len(factors) != len(poses):
        _refuse(path, f"focal_factors: expected {len(poses)} as poses, found {len(factors)}")
    return CameraPath(
        world_to_camera=_checked(path, poses),
        focal=content.fy / content.height * np.array(factors or (1.0,) * len(poses)),
        size=(content.width, content.height),
        fps=content.fps,
        world="gaussians",
        label=PathFile.file_name,
    )


def _of_nerfstudio(path: Path, content: _Nerfstudio) -> CameraPath:
    cameras = content.camera_path
    try:
        poses = [pose_matrix(path, f"camera {i}", c.camera_to_world) for i, c in enumerate(cameras)]
    except UserError as error:
        _refuse(path, error.what)
    return CameraPath(
        world_to_camera=_checked(path, _inverse(np.array(poses).reshape(-1, 4, 4), _OPENGL)),
        focal=_focal([camera.fov for camera in cameras]),
        size=(content.render_width, content.render_height),
        fps=None if content.fps is None else round(content.fps),
        world="cameras",
        label="nerfstudio's camera_path.json",
    )


def _of_frames(path: Path, content: _Frames) -> CameraPath:
    values = [[f.position, f.target, f.up] for f in content.frames]
    position, target, up = np.moveaxis(np.array(values).reshape(-1, 3, 3) @ _PLAYCANVAS, 1, 0)
    forward, up = _unit(target - position), _unit(up)
    right = np.cross(forward, up)
    if not (np.linalg.norm(right, axis=1) > _LEAST_SINE).all():
        first = int(np.argmin(np.linalg.norm(right, axis=1) > _LEAST_SINE))
        _refuse(path, f"frames.{first}: expected a target away from the position, not along up")
    right = _unit(right)
    poses = np.tile(np.eye(4), (len(position), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=2)
    poses[:, :3, 3] = position
    return CameraPath(
        world_to_camera=_checked(path, _inverse(poses, np.eye(3))),
        focal=_focal([frame.fov for frame in content.frames]),
        size=None,
        fps=None if content.frameRate is None else round(content.frameRate),
        world="gaussians",
        label="a list of frames",
    )


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def _focal(fov_deg: list[float]) -> Array:
    return np.asarray(0.5 / np.tan(np.radians(fov_deg) / 2))


def _inverse(poses: Array, axes: Array) -> Array:
    """World to camera, from (N, 4, 4) camera to world whose camera axes are turned by ``axes``."""
    inverse = np.tile(np.eye(4), (len(poses), 1, 1))
    inverse[:, :3, :3] = (poses[:, :3, :3] @ axes).transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("nij,nj->ni", inverse[:, :3, :3], poses[:, :3, 3])
    return inverse


def _checked(path: Path, poses: Array) -> Array:
    """(N, 4, 4) poses with exact rotations."""
    found = np.tile(np.eye(4), (len(poses), 1, 1))
    try:
        for i, pose in enumerate(poses):
            matrix = pose_matrix(path, f"camera {i}", pose)
            centre = -matrix[:3, :3].T @ matrix[:3, 3]
            found[i, :3, :3], found[i, :3, 3] = checked_pose(
                path, f"camera {i}", matrix[:3, :3], centre
            )
    except UserError as error:
        _refuse(path, error.what)
    return found


_KINDS: tuple[tuple[str, type[BaseModel], Callable[[Path, Any], CameraPath]], ...] = (
    ("world_to_camera", PathFile, _of_path_file),
    ("camera_path", _Nerfstudio, _of_nerfstudio),
    ("frames", _Frames, _of_frames),
)
