"""OpenSfM (and OpenDroneMap): ``reconstruction.json``.

Shots have a rotation vector and a translation, world to camera with COLMAP's axes. Cameras are in
units of the longer side of the image, from its centre. Source: OpenSfM's documentation, "Dataset
Structure" and "Camera Models". Its points are not read: they are triangulated again.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.geometry.rotations import rotation_from_vector
from pipeline.io.poses.files import first_file, malformed, number, numbers, read_json
from pipeline.io.poses.frames import Lens, PosedFrame, checked_camera, make_frame
from pipeline.io.poses.lenses import Brown, brown_camera
from pipeline.runtime.text import shown

_FILES = ("reconstruction.json", "opensfm/reconstruction.json")
# Rotation vectors of one turn at most, in radians; those of degrees are rarely as short.
_MAX_ANGLE = 2 * np.pi + 1e-3
_KINDS = "perspective, simple_radial, radial, brown, fisheye, fisheye_opencv, fisheye62"


def find(folder: Path) -> str | None:
    return first_file(folder, _FILES)


def frames(file: Path) -> list[PosedFrame]:
    """The shots of the reconstruction that has the most; others have worlds of their own.

    Raises:
        UserError: a malformed file, or a camera that is not supported.
    """
    content = read_json(file)
    parts = [
        part
        for part in (content if isinstance(content, list) else [])
        if isinstance(part, dict)
        and isinstance(part.get("shots"), dict)
        and isinstance(part.get("cameras"), dict)
    ]
    if not parts:
        raise malformed(file, "expected a list of reconstructions with cameras and shots")
    largest = max(parts, key=lambda part: len(part["shots"]))
    found = []
    for name, shot in largest["shots"].items():
        where = f"shot {shown(name)}"
        camera = shot.get("camera") if isinstance(shot, dict) else None
        if not isinstance(camera, str) or camera not in largest["cameras"]:
            raise malformed(file, f"{where}: expected one of the file's cameras")
        lens = _lens(file, f"camera {shown(camera)}", largest["cameras"][camera])
        vector = numbers(file, f"{where}: rotation", shot.get("rotation"), 3)
        angle = float(np.linalg.norm(vector))
        if angle > _MAX_ANGLE:
            raise malformed(
                file,
                f"{where}: expected a rotation vector in radians, found an angle of {angle:g}; it "
                "looks like degrees",
                fix="multiply the rotation vectors by pi / 180, or set poses: ignore",
            )
        rotation = rotation_from_vector(vector)
        translation = numbers(file, f"{where}: translation", shot.get("translation"), 3)
        with np.errstate(all="ignore"):
            centre = -rotation.T @ translation
        found.append(make_frame(file, name, lens, rotation, centre, where))
    if not found:
        raise malformed(file, "expected a shot, found none")
    return found


def _lens(file: Path, where: str, camera: Any) -> Lens:
    if not isinstance(camera, dict):
        raise malformed(file, f"{where}: expected an object")
    kind = str(camera.get("projection_type", "perspective"))[:40]

    def value(name: str, default: float = 0.0) -> float:
        return number(file, f"{where}: {name}", camera.get(name, default))

    width, height = value("width"), value("height")
    side = max(width, height)
    fx = value("focal_x") if "focal_x" in camera else value("focal")
    fy = value("focal_y") if "focal_y" in camera else fx
    point = width / 2 + value("c_x") * side, height / 2 + value("c_y") * side
    k = tuple(value(f"k{i}") for i in range(1, 7))
    p = value("p1"), value("p2")
    if kind == "fisheye62":
        params = (fx * side, fy * side, *point, *k, p[0], p[1], 0.0, 0.0, 0.0, 0.0)
        model = "RAD_TAN_THIN_PRISM_FISHEYE"
        # OpenSfM's p1 and p2 are OpenCV's; the first of COLMAP's model belongs to x.
        params = (*params[:10], p[1], p[0], *params[12:])
        return Lens.fixed(checked_camera(file, where, model, width, height, params))
    if kind not in _KINDS.split(", "):
        raise malformed(
            file,
            f"{where}: {kind} cameras are not supported; expected {_KINDS}",
            fix="export undistorted perspective photographs (opensfm undistort), or set "
            "poses: ignore",
        )
    fisheye = kind.startswith("fisheye")
    radial = k[:4] if kind == "fisheye_opencv" else k[:3]
    lens = Brown(fx * side, fy * side, *point, k=radial, p=p, fisheye=fisheye)
    return Lens.fixed(brown_camera(file, where, width, height, lens))
