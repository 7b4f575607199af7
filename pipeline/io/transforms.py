"""``transforms.json``: the camera format of instant-ngp, nerfstudio and NeRF-synthetic.

``transform_matrix`` is camera to world with OpenGL axes (x right, y up, z backward); negating y
and z gives COLMAP's. nerfstudio may have transformed COLMAP's world by ``applied_transform`` and
``applied_scale``; both are undone. Source: nerfstudio's documentation, "Data conventions".
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.io.names import first_names
from pipeline.io.poses.files import FIX, checked_name, is_number, malformed, read_json
from pipeline.io.poses.frames import (
    FLIP_YZ,
    Lens,
    ListedSplit,
    PosedFrame,
    checked_camera,
    checked_pose,
    reconstruct,
)
from pipeline.io.poses.matrices import pose_matrix
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.text import shown
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

SPLITS: tuple[ListedSplit, ...] = ("train", "test", "val")
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
# Scales of nerfstudio's world relative to COLMAP's. Their cubes are far from a float's range.
_SCALES = (1e-12, 1e12)
_LISTS = tuple(f"{name}_filenames" for name in SPLITS)
# Units farther apart are a mistake, and overflow where they are multiplied.
_SMALLEST_SCALE = 1e-15
# Poses that differ by less, relative to the translation, are equal.
_EQUAL = 1e-5
# The fields of a frame's mask and depth map, of nerfstudio and of others.
_COMPANIONS = (
    ("mask_path", "mask_file_path"),
    ("depth_file_path", "depth_path"),
)


@dataclass(frozen=True)
class Fields:
    """The fields of a frame that describe its camera.

    Attributes:
        file: The json.
        source: "frames[i] (PATH)", for messages.
        values: The file's fields, overridden by the frame's.
    """

    file: Path
    source: str
    values: Mapping[str, Any]

    def wrong(self, what: str, fix: str = FIX) -> UserError:
        """The error for values that no camera can have."""
        return malformed(self.file, f"{self.source}: {what}", fix)

    def number(self, name: str, default: float = 0.0) -> float:
        """The field ``name``, which must be a finite number."""
        value = self.values.get(name, default)
        if not is_number(value):
            raise self.wrong(f"{name} is {str(value)[:40]!r}, expected a finite number")
        return float(value)

    def focal(self, length: str, angle: str, side: int) -> float | None:
        """The focal length in pixels from the field ``length``, or from the field of view ``angle``
        in radians; None without either."""
        if length in self.values:
            focal = self.number(length)
            if focal <= 0:
                raise self.wrong(f"{length} is {focal}, expected a positive number")
            return focal
        if angle not in self.values:
            return None
        view = self.number(angle)
        if not 0 < view < math.pi:
            what = f"{angle} is {view:g}, expected radians between 0 and pi"
            if not math.pi <= view < 180:
                raise self.wrong(what)
            fix = f"write {math.radians(view):.6g}, or set poses: ignore"
            raise self.wrong(f"{what}; it looks like degrees", fix)
        return 0.5 * side / math.tan(0.5 * view)

    def model(self) -> str:
        """The COLMAP camera model of the intrinsics.

        Raises:
            UserError: a ``camera_model`` that is not supported.
        """
        model = str(self.values.get("camera_model", "")).upper()
        if model == "OPENCV_FISHEYE" or self.values.get("is_fisheye"):
            return "OPENCV_FISHEYE"
        if model == "EQUIRECTANGULAR":
            return model
        if model and model not in _PERSPECTIVE:
            raise self.wrong(
                f"camera_model {model[:40]} is not supported; expected "
                f"{', '.join(_PERSPECTIVE)}, OPENCV_FISHEYE or EQUIRECTANGULAR",
                "convert the photographs to perspective ones, or set poses: ignore",
            )
        if any(self.number(name) for name in ("k3", "k4", "k5", "k6")):
            return "FULL_OPENCV"
        return (
            "OPENCV" if any(self.number(name) for name in ("k1", "k2", "p1", "p2")) else "PINHOLE"
        )

    def camera(self, photo_width: int, photo_height: int) -> Camera:
        """The camera, of the photograph's size if the fields have none."""
        width, height = round(self.number("w", photo_width)), round(self.number("h", photo_height))
        model = self.model()
        if model == "EQUIRECTANGULAR":
            if not 0 < width == 2 * height:
                raise self.wrong(
                    f"the panorama is {width}x{height} pixels; expected 360 by 180 degrees, "
                    "twice as wide as high"
                )
            return Camera(model, width, height, np.array([width, height], np.float64))
        fx = self.focal("fl_x", "camera_angle_x", width)
        fy = self.focal("fl_y", "camera_angle_y", height)
        if fx is None and fy is None:
            raise self.wrong("no focal length: expected fl_x or camera_angle_x")
        point = self.number("cx", width / 2), self.number("cy", height / 2)
        rest = [self.number(name) for name in CAMERA_MODELS[model][1][4:]]
        params = [fx or fy or 0.0, fy or fx or 0.0, *point, *rest]
        return checked_camera(self.file, self.source, model, width, height, params)


@dataclass(frozen=True, kw_only=True)
class Frame(PosedFrame):
    """A frame of a transforms.json, whose name is relative to the folder of the file.

    Attributes:
        fields: The fields that describe the camera.
    """

    fields: Fields

    def has_same_pose(self, other: Frame) -> bool:
        """Whether the poses are equal up to the digits that files are printed with."""
        size = max(1.0, float(np.abs(self.translation).max()))
        return bool(
            np.abs(self.rotation - other.rotation).max() < _EQUAL
            and np.abs(self.translation - other.translation).max() < _EQUAL * size
        )

    def is_same_camera(self, other: Frame) -> bool:
        """Whether pose and intrinsics are equal."""
        same = np.array_equal(self.translation, other.translation)
        return same and self.fields.values == other.fields.values


def find_transforms(folder: Path) -> list[Path]:
    """The pose files of a scene: transforms.json, else transforms_{train,test,val}.json."""
    single = folder / "transforms.json"
    if single.is_file():
        return [single]
    split = [folder / f"transforms_{name}.json" for name in SPLITS]
    return [path for path in split if path.is_file()]


def read_frames(path: Path, repeated: list[str] | None = None) -> list[Frame]:
    """All frames of a file or of the files in a scene folder, each path once: its first frame.

    Args:
        repeated: The paths of the other frames are added to this list, except for equal frames:
            files of several splits may list the same frames.

    Raises:
        UserError: No file, malformed JSON, missing fields, matrices that are not finite poses,
            camera models that are not supported, a path with two poses.
    """
    files = [path] if path.is_file() else find_transforms(path)
    if not files:
        raise malformed(path, "expected a transforms.json, found none")
    frames: dict[str, Frame] = {}
    for frame in (frame for file in files for frame in _frames_of(file)):
        first = frames.setdefault(frame.name, frame)
        if first is frame or first.is_same_camera(frame):
            continue
        if not first.has_same_pose(frame):
            new, old = frame.fields, first.fields
            raise malformed(
                new.file,
                f"{new.source} and {old.source} of {old.file.name} are the same photograph with "
                "different poses",
                f"remove one of the two frames of {first_names([frame.name])}, or set poses: "
                "ignore",
            )
        if repeated is not None:
            repeated.append(frame.name)
    return list(frames.values())


def read_transforms(path: Path, sizes: Mapping[str, tuple[int, int]]) -> Reconstruction:
    """Poses of the frames whose photographs exist.

    Args:
        path: A scene folder or a file.
        sizes: The width and height in pixels by photograph, relative to the folder of the json.
            Frames of other photographs are omitted; suffixes may differ. Intrinsics refer to
            these sizes if the file has no ``w`` and ``h``.

    Returns:
        Images named by the keys of ``sizes``, cameras of the file's sizes, no points.

    Raises:
        UserError: See ``read_frames``; or intrinsics are missing or impossible.
    """
    return reconstruct(read_frames(path), sizes, path)


@dataclass(frozen=True)
class PointsEntry:
    """The point cloud that a pose file names.

    Attributes:
        path: The cloud's path relative to the folder of the json; None if it names none.
        to_world: The (4, 4) similarity from the coordinates of the file's matrices, and of its
            points, to those of ``read_frames``.
    """

    path: str | None
    to_world: NDArray[np.float64]


def read_points_entry(path: Path) -> PointsEntry:
    """The point cloud of a pose file, or of the files in a scene folder.

    Raises:
        UserError: See ``read_frames``.
    """
    frames = read_frames(path)
    if not frames:
        return PointsEntry(None, np.eye(4))
    fields = frames[0].fields
    name = fields.values.get("ply_file_path")
    named = checked_name(fields.file, name) if isinstance(name, str) and name else None
    to_world = np.linalg.inv(_applied_transform(fields.file, fields.values))
    return PointsEntry(named, to_world.astype(np.float64))


def write_transforms(
    path: Path, views: Sequence[View], folder: Path, *, points: str | None = None
) -> None:
    """Write pinhole cameras for nerfstudio and instant-ngp atomically; test views become both
    test and validation views.

    Args:
        folder: The json's final folder, to which paths of photographs are relative.
        points: The initial point cloud, relative to ``folder``.
    """

    def relative(file: str) -> str:
        # Symbolic links are resolved, because ".." refers to the parent of their target.
        parent, name = os.path.split(file)
        inside = os.path.relpath(os.path.realpath(parent), os.path.realpath(folder))
        return (Path(inside) / name).as_posix()

    frames: list[dict[str, Any]] = []
    intrinsics: list[dict[str, Any]] = []
    for view in views:
        to_world = np.eye(4)
        to_world[:3, :3] = view.world_to_camera[:3, :3].T @ FLIP_YZ
        to_world[:3, 3] = view.centre
        frames.append(
            {"file_path": relative(view.image), "transform_matrix": to_world.tolist()}
            | ({"mask_path": relative(view.mask)} if view.mask else {})
        )
        # OPENCV with zero distortion: the pinhole camera that all readers support.
        intrinsics.append(
            {"camera_model": "OPENCV", "w": view.width, "h": view.height}
            | {"fl_x": view.fx, "fl_y": view.fy, "cx": view.cx, "cy": view.cy}
            | {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
        )
    content: dict[str, Any] = {"frames": frames}
    if intrinsics and all(entry == intrinsics[0] for entry in intrinsics):
        content |= intrinsics[0]
    else:
        for frame, entry in zip(frames, intrinsics, strict=True):
            frame |= entry
    test_files = [f["file_path"] for f, view in zip(frames, views, strict=True) if view.is_test]
    if test_files:
        content["train_filenames"] = [
            f["file_path"] for f, view in zip(frames, views, strict=True) if not view.is_test
        ]
        content["val_filenames"] = content["test_filenames"] = test_files
    if points is not None:
        content["ply_file_path"] = points
    write_json(path, content)


def _frames_of(file: Path) -> list[Frame]:
    content = read_json(file)
    listed = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(listed, list):
        raise malformed(file, "expected an object with a list 'frames'")
    applied = _applied_transform(file, content)
    shared = {key: value for key, value in content.items() if key not in ("frames", *_LISTS)}
    frames = [_frame(file, i, entry, shared, applied) for i, entry in enumerate(listed)]
    split_of = _splits(file, content)
    return [replace(frame, split=split_of(frame.name)) for frame in frames]


def _splits(file: Path, content: Mapping[str, Any]) -> Callable[[str], ListedSplit | None]:
    """The function from a frame's photograph to the list that it is in."""
    whole: dict[str, ListedSplit] = {f"transforms_{name}.json": name for name in SPLITS}
    if file.name in whole:
        return lambda path: whole[file.name]
    found: dict[str, ListedSplit] = {}
    for name in SPLITS:
        listed = content.get(f"{name}_filenames")
        for entry in listed if isinstance(listed, list) else []:
            if isinstance(entry, str):
                found.setdefault(checked_name(file, entry), name)
    return lambda path: found.get(path, "none") if found else None


def _frame(
    file: Path, i: int, entry: Any, shared: Mapping[str, Any], applied: NDArray[np.float64]
) -> Frame:
    own = entry if isinstance(entry, dict) else {}
    name = _file_name(file, f"frames[{i}].file_path", own.get("file_path"))
    fields = Fields(file, f"frames[{i}] ({name})", {**shared, **own})
    where = f"{fields.source}.transform_matrix"
    matrix = pose_matrix(file, where, own.get("transform_matrix"))
    scale = np.cbrt(max(np.linalg.det(applied[:3, :3]), 1e-300))
    with np.errstate(over="ignore", invalid="ignore"):
        to_world = np.linalg.inv(applied) @ matrix
    # The camera's axes are affected by the rotation of applied_transform only, not by its scale.
    axes = to_world[:3, :3] * scale
    pose = checked_pose(file, where, FLIP_YZ @ axes.T, to_world[:3, 3])
    mask, depth = (_optional_file(file, fields.source, own, names) for names in _COMPANIONS)
    lens = Lens(fields.model(), fields.camera)
    return Frame(name, lens, *pose, mask=mask, depth=depth, fields=fields)


def _optional_file(
    file: Path, source: str, fields: Mapping[str, Any], names: Sequence[str]
) -> str | None:
    """The file that the first of the fields ``names`` has, or None."""
    name = next((name for name in names if fields.get(name)), None)
    return None if name is None else _file_name(file, f"{source}.{name}", fields[name])


def _file_name(file: Path, where: str, value: Any) -> str:
    """``checked_name`` of a field."""
    if not isinstance(value, str) or not value:
        raise malformed(file, f"{where}: expected a file name, found {shown(value)}")
    return checked_name(file, value, f"{where}: ")


def _applied_transform(file: Path, content: Mapping[str, Any]) -> NDArray[np.float64]:
    """(4, 4) similarity from COLMAP's world to the file's."""
    applied = np.eye(4)
    if "applied_transform" in content:
        applied = pose_matrix(file, "applied_transform", content["applied_transform"])
    scale = content.get("applied_scale", 1.0)
    if not is_number(scale) or not _SMALLEST_SCALE < scale < 1 / _SMALLEST_SCALE:
        raise malformed(file, f"applied_scale: expected a positive number, found {shown(scale)}")
    # The largest element of the axes: between their length and its third.
    size = float(np.abs(applied[:3, :3]).max())
    if not (_SCALES[0] <= scale * size <= _SCALES[1] and _SCALES[0] <= size <= _SCALES[1]):
        raise malformed(
            file,
            f"applied_scale, applied_transform: expected a scale of {_SCALES[0]:g} to "
            f"{_SCALES[1]:g}, found {scale * size:g}",
        )
    applied[:3] *= scale
    # The determinant is a volume, so it is compared with the axes' length cubed.
    if not np.linalg.det(applied[:3, :3]) > 1e-6 * (scale * size) ** 3:
        raise malformed(file, "applied_transform: expected a similarity")
    return applied
