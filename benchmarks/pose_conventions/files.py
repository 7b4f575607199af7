"""Pose files of four programs as people write them by mistake, from right poses.

The formulas are those of the formats' documentation, not of the pipeline's readers.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import rotation_to_quat
from pipeline.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mistake = Literal["", "axes", "inverse", "transposed", "angles", "mirrored", "other"]

_FLIP = np.diag([1.0, -1.0, -1.0])
_FILM_MM = 36.0
# The longest difference of two rotation vectors that are the same rotation.
_TINY = 1e-12


@dataclass(frozen=True)
class Pose:
    """A photograph's right pose: world to camera with COLMAP's axes, and the camera's centre."""

    name: str
    rotation: Array
    centre: Array
    camera: Camera


def poses_of(model: Reconstruction) -> list[Pose]:
    """The poses in the order of names."""
    found = [
        Pose(image.name, image.rotation, image.centre, model.cameras[image.camera_id])
        for image in model.images.values()
    ]
    return sorted(found, key=lambda pose: pose.name)


@dataclass(frozen=True)
class Program:
    """A program's pose file.

    Attributes:
        name: The name of the program in tables.
        write: The function that writes its pose file into a scene folder, with one mistake.
        named: What the message says about each mistake, as regular expressions.
    """

    name: str
    write: Callable[[Path, list[Pose], Mistake], None]
    named: dict[Mistake, str] = field(default_factory=dict)


def _shifted(poses: list[Pose]) -> list[Pose]:
    """The poses, each with the name of the photograph after its own."""
    names = [pose.name for pose in poses]
    return [
        Pose(name, pose.rotation, pose.centre, pose.camera)
        for name, pose in zip([*names[1:], names[0]], poses, strict=True)
    ]


def _brown(camera: Camera) -> tuple[float, ...]:
    """The coefficients k1, k2, p1, p2 and k3 of a camera; zero without distortion."""
    coefficients = camera.params[4:].tolist() if camera.model in ("OPENCV", "FULL_OPENCV") else []
    return tuple([*coefficients, 0.0, 0.0, 0.0, 0.0, 0.0][:5])


def _swapped(vector: Array) -> Array:
    """The vector with y and z exchanged."""
    return vector[[0, 2, 1]]


def write_transforms(folder: Path, poses: list[Pose], mistake: Mistake) -> None:
    """nerfstudio and instant-ngp: camera to world with OpenGL's axes."""
    frames = []
    for pose in poses:
        matrix: Array = np.eye(4)
        axes = np.eye(3) if mistake == "axes" else _FLIP
        matrix[:3, :3] = pose.rotation.T @ axes
        matrix[:3, 3] = pose.centre
        if mistake == "inverse":
            matrix = np.asarray(np.linalg.inv(matrix), np.float64)
        if mistake == "transposed":
            matrix = matrix.T
        if mistake == "mirrored":
            matrix[[1, 2]] = matrix[[2, 1]]
        fx, fy, cx, cy = pose.camera.pinhole
        width, height = pose.camera.width, pose.camera.height
        k1, k2, p1, p2, _ = _brown(pose.camera)
        entry: dict[str, object] = {
            "file_path": f"images/{pose.name}",
            "transform_matrix": matrix.tolist(),
        }
        if mistake == "angles":
            angles = [2 * np.degrees(np.arctan(s / 2 / f)) for s, f in ((width, fx), (height, fy))]
            entry |= {"camera_angle_x": angles[0], "camera_angle_y": angles[1]}
        else:
            scale = 0.5 if mistake == "other" else 1.0
            entry |= {"fl_x": fx * scale, "fl_y": fy * scale, "cx": cx * scale, "cy": cy * scale}
        frames.append(entry | {"k1": k1, "k2": k2, "p1": p1, "p2": p2})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))


def write_colmap(folder: Path, poses: list[Pose], mistake: Mistake) -> None:
    """COLMAP's text model: world to camera, quaternions with the real part first."""
    cameras: list[str] = []
    lines: list[str] = []
    for i, pose in enumerate(_shifted(poses) if mistake == "other" else poses, 1):
        rotation, centre = pose.rotation, pose.centre
        if mistake == "mirrored":
            centre = centre * [-1, 1, 1]
        translation = -rotation @ centre
        if mistake == "axes":
            rotation, translation = _FLIP @ rotation, _FLIP @ translation
        if mistake == "inverse":
            rotation, translation = rotation.T, centre
        if mistake == "transposed":
            rotation = rotation.T
        quaternion = rotation_to_quat(rotation)
        if mistake == "angles":
            quaternion = quaternion[[1, 2, 3, 0]]
        camera = pose.camera
        line = f"{camera.model} {camera.width} {camera.height} " + _line(camera.params)
        if line not in cameras:
            cameras.append(line)
        number = cameras.index(line) + 1
        lines += [f"{i} {_line(quaternion)} {_line(translation)} {number} {pose.name}", ""]
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(
        "".join(f"{i} {line}\n" for i, line in enumerate(cameras, 1))
    )
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("")


def write_opensfm(folder: Path, poses: list[Pose], mistake: Mistake) -> None:
    """OpenSfM and OpenDroneMap: rotation vectors and translations, world to camera."""
    shots, cameras = {}, {}
    for pose in poses:
        rotation = pose.rotation
        centre = _swapped(pose.centre) if mistake == "mirrored" else pose.centre
        translation = -rotation @ centre
        if mistake == "axes":
            rotation, translation = _FLIP @ rotation, _FLIP @ translation
        if mistake == "inverse":
            rotation, translation = rotation.T, centre
        if mistake == "transposed":
            rotation = rotation.T
        vector = _rotation_vector(rotation) * (180 / np.pi if mistake == "angles" else 1)
        camera = pose.camera
        fx, fy, cx, cy = camera.pinhole
        side = max(camera.width, camera.height)
        # This mistake divides a focal length by the other side of the image.
        divisor = min(camera.width, camera.height) if mistake == "other" else side
        k1, k2, p1, p2, k3 = _brown(camera)
        key = f"camera {camera.width}x{camera.height} {fx:.3f}"
        cameras[key] = {
            "projection_type": "brown",
            "width": camera.width,
            "height": camera.height,
            "focal_x": fx / divisor,
            "focal_y": fy / divisor,
            "c_x": (cx - camera.width / 2) / side,
            "c_y": (cy - camera.height / 2) / side,
            **{"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2},
        }
        shots[pose.name] = {
            "rotation": vector.tolist(),
            "translation": translation.tolist(),
            "camera": key,
        }
    content = [{"cameras": cameras, "shots": shots, "points": {}}]
    (folder / "reconstruction.json").write_text(json.dumps(content))


def write_realitycapture(folder: Path, poses: list[Pose], mistake: Mistake) -> None:
    """RealityCapture's CSV: centres, and heading, pitch and roll of cameras with OpenGL's axes."""
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for pose in _shifted(poses) if mistake == "other" else poses:
        camera = pose.camera
        to_world = pose.rotation.T @ (np.eye(3) if mistake == "axes" else _FLIP)
        position = pose.centre
        if mistake == "inverse":
            to_world, position = to_world.T, -to_world.T @ position
        if mistake == "transposed":
            to_world = to_world.T
        if mistake == "mirrored":
            position = position[[1, 0, 2]]
        angles = _heading_pitch_roll(to_world)
        if mistake != "angles":
            angles = np.degrees(angles)
        side = max(camera.width, camera.height)
        fx, _, cx, cy = camera.pinhole
        point = ((cx - camera.width / 2) / side, (cy - camera.height / 2) / side)
        k1, k2, p1, p2, k3 = _brown(camera)
        values = [*position, *angles, fx / side * _FILM_MM, *point, k1, k2, k3, 0.0, p1, p2]
        lines.append(",".join([pose.name, *(repr(float(value)) for value in values)]))
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n")


def _line(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)


def _rotation_vector(rotation: Array) -> Array:
    w, *xyz = rotation_to_quat(rotation).tolist()
    sine = float(np.linalg.norm(xyz))
    return np.array(xyz) * (2 * np.arctan2(sine, w) / max(sine, _TINY))


def _heading_pitch_roll(to_world: Array) -> Array:
    """The angles in radians of Rz(-heading) Rx(pitch) Ry(roll)."""
    heading = -np.arctan2(-to_world[0, 1], to_world[1, 1])
    pitch = np.arcsin(np.clip(to_world[2, 1], -1, 1))
    return np.array([heading, pitch, np.arctan2(-to_world[2, 0], to_world[2, 2])])


_ORDER = r"each photograph has the pose of the one"
_WORLDS = r"different axes|mirrored"

PROGRAMS = (
    Program(
        "transforms.json",
        write_transforms,
        {
            "axes": r"camera axes look like COLMAP's",
            "inverse": r"look like world to camera",
            "transposed": r"the matrix is transposed",
            "angles": r"looks like degrees",
            "mirrored": r"mirrored",
            "other": r"images (2|0\.5) times as large|focal length looks like",
        },
    ),
    Program(
        "COLMAP text",
        write_colmap,
        {
            "axes": r"camera axes look like OpenGL's",
            "inverse": r"look like camera to world",
            "transposed": r"rotations look transposed",
            "angles": r"order of the quaternions",
            "mirrored": _WORLDS,
            "other": _ORDER,
        },
    ),
    Program(
        "OpenSfM",
        write_opensfm,
        {
            "axes": r"camera axes look like OpenGL's",
            "inverse": r"look like camera to world",
            "transposed": r"rotations look transposed",
            "angles": r"looks like degrees",
            "mirrored": _WORLDS,
            "other": r"focal length looks like",
        },
    ),
    Program(
        "RealityCapture CSV",
        write_realitycapture,
        {
            "axes": r"camera axes look like COLMAP's",
            "inverse": r"look like world to camera",
            "transposed": r"rotations look transposed",
            "angles": r"angles look like radians",
            "mirrored": _WORLDS,
            "other": _ORDER,
        },
    ),
)
