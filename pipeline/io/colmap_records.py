"""Records of COLMAP's model files and their checks, shared by the binary and the text format.

Functions raise a ``UserError`` that names ``file`` for values that no model can have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.geometry.rotations import quat_to_rotation
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import PosedImage

REMEDY = "export the model again from COLMAP (binary or text), or set poses: ignore"
POINT2D = np.dtype([("xy", "<f8", (2,)), ("point", "<u8")])
"""A keypoint as in binary files: position in pixels, and id of its 3D point."""
Keypoints = dict[int, NDArray[np.void]]
"""Image id -> keypoints (``POINT2D``), for writing."""


@dataclass(frozen=True)
class Tracks:
    """The tracks of P points, concatenated.

    Attributes:
        length: (P,) the number of observations of each point.
        image, index: (M,) the image id of each observation, and its index among the image's
            keypoints.
    """

    length: NDArray[np.int64]
    image: NDArray[np.int64]
    index: NDArray[np.int64]


@dataclass(frozen=True)
class PointTable:
    """The content of ``points3D``, in the file's order.

    Attributes:
        ids: (P,) the points' ids.
        xyz: (P, 3) the positions in the world.
        rgb: (P, 3) the colours.
        error: (P,) the reprojection errors in pixels.
        tracks: The tracks of the points.
    """

    ids: NDArray[np.int64]
    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    error: NDArray[np.float64]
    tracks: Tracks


def malformed(file: Path, what: str, fix: str = REMEDY) -> UserError:
    """The error for a file that is no part of a COLMAP model."""
    return UserError(what, file=file, fix=fix)


def make_camera(
    file: Path, number: int, name: str, width: int, height: int, p: list[float]
) -> Camera:
    """The camera with id ``number``, model ``name`` and parameters ``p``, checked."""
    names = CAMERA_MODELS[name][1]
    if len(p) != len(names):
        raise malformed(
            file,
            f"camera {number}: {name} has {len(names)} parameters ({', '.join(names)}), "
            f"found {len(p)}",
        )
    camera = Camera(name, width, height, np.array(p, np.float64))
    if not (0 < width < 2**31 and 0 < height < 2**31):
        raise malformed(file, f"camera {number}: impossible size {width}x{height}")
    if not np.isfinite(camera.params).all() or min(camera.pinhole[:2]) <= 0:
        raise malformed(
            file,
            f"camera {number}: expected finite parameters and a positive focal length, found {p}",
        )
    if camera.is_spherical and p != [width, height]:
        raise malformed(
            file,
            f"camera {number}: expected the image's size {width}x{height} as parameters of "
            f"{name}, found {p}",
        )
    return camera


def make_image(
    file: Path, name: str, camera_id: int, quat: list[float], translation: list[float]
) -> PosedImage:
    """An image with the pose ``quat`` (wxyz) and ``translation``, world to camera, checked."""
    q, t = np.array(quat, np.float64), np.array(translation, np.float64)
    norm = math.hypot(*quat)
    if not (1e-12 < norm < 1e12) or not np.isfinite(t).all():
        raise malformed(
            file,
            f"image {name}: expected a finite pose, found quaternion {quat}, "
            f"translation {translation}",
            fix=f"remove {name} from the model, or set poses: ignore",
        )
    return PosedImage(name, camera_id, quat_to_rotation(q), t)


def add_image(
    file: Path,
    images: dict[int, PosedImage],
    cameras: dict[int, Camera],
    number: int,
    image: PosedImage,
) -> None:
    """Add the image with id ``number`` to ``images``."""
    if image.camera_id not in cameras:
        raise malformed(
            file,
            f"image {image.name} belongs to camera {image.camera_id}, which is not in the model",
        )
    if number in images:
        raise malformed(file, f"expected unique image ids, found {number} twice")
    images[number] = image


def unknown_model(file: Path, number: int, found: str) -> UserError:
    """The error of camera ``number`` with the unsupported model ``found``."""
    return malformed(
        file,
        f"camera {number}: unknown camera model {found}; expected {', '.join(CAMERA_MODELS)}",
        fix="undistort in COLMAP first (colmap image_undistorter), or set poses: ignore",
    )
