"""Posed frames, the form in which readers of pose files return them, and checks of their values.

Functions raise a ``UserError`` that names the file for values that no camera can have.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.geometry.rotations import rotation_from_vector
from pipeline.io.names import match_names
from pipeline.io.poses.files import checked_name, malformed
from pipeline.io.poses.matrices import rotation_fault
from pipeline.runtime.text import shown
from pipeline.scene.reconstruction import PosedImage, Reconstruction

Array = NDArray[np.float64]
ListedSplit = Literal["train", "test", "val", "none"]
"""The list of a scene's own split that a frame is in; "none": a frame that is in no list."""

#: Between OpenGL's axes of a camera (x right, y up, z backward) and COLMAP's.
FLIP_YZ = np.diag([1.0, -1.0, -1.0])
# Larger coordinates have no use: float64 has less than a millimetre left at 1e12 metres.
_MAX_COORDINATE = 1e12
# Matrices printed with few digits deviate this much from a rotation.
_ROTATION_TOLERANCE = 1e-2
_MAX_SIDE = 1_000_000


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a frame, which may refer to the photograph's size.

    Attributes:
        model: The camera model of the cameras that ``make`` returns.
        make: The camera for a photograph of a width and height in pixels.
    """

    model: str
    make: Callable[[int, int], Camera]

    @staticmethod
    def fixed(camera: Camera) -> Lens:
        """A camera of known size; ``fit_to_photos`` resizes it to the photographs."""
        return Lens("PINHOLE" if camera.is_pinhole else camera.model, lambda width, height: camera)


@dataclass(frozen=True)
class PosedFrame:
    """A photograph's pose in a file of another program.

    Attributes:
        name: The photograph, as in ``PosedImage.name``, or relative to the scene folder
            (``PoseFormat.names``); suffix and leading folders may be missing.
        lens: The intrinsics.
        rotation, translation: The pose, world to camera in COLMAP's axes; (3, 3) and (3,) float64.
        mask: The mask's file relative to the scene folder, or None.
        depth: The depth map's file relative to the scene folder, or None.
        split: The list of the scene's own split that it is in; None if the scene has no split.
    """

    name: str
    lens: Lens
    rotation: Array
    translation: Array
    mask: str | None = None
    split: ListedSplit | None = None
    depth: str | None = None


def distinct_frames(frames: Iterable[PosedFrame]) -> list[PosedFrame]:
    """The frames without those that repeat the name and pose of an earlier one."""
    # Adding 0 turns -0 into 0, so that equal poses have equal bytes.
    found: dict[tuple[str, bytes, bytes], PosedFrame] = {}
    for frame in frames:
        pose = (frame.rotation + 0.0).tobytes(), (frame.translation + 0.0).tobytes()
        found.setdefault((frame.name, *pose), frame)
    return list(found.values())


def reconstruct(
    frames: Iterable[PosedFrame],
    sizes: Mapping[str, tuple[int, int]],
    file: str | Path = "poses",
) -> Reconstruction:
    """The frames whose photographs exist.

    Args:
        sizes: The width and height in pixels by photograph.
        file: The pose file, for error messages.

    Returns:
        Images named by the keys of ``sizes``, one camera for equal intrinsics, no points.

    Raises:
        UserError: Names are ambiguous (``match_names``).
    """
    distinct = distinct_frames(frames)
    by_name = {frame.name: frame for frame in distinct}
    cameras: dict[tuple[Any, ...], int] = {}
    made: dict[tuple[Lens, int, int], Camera] = {}  # Some lenses are fitted, which takes time.
    by_id: dict[int, Camera] = {}
    images: dict[int, PosedImage] = {}
    found = match_names([frame.name for frame in distinct], sizes, file)
    for number, (photo, name) in enumerate(sorted(found.items()), 1):
        frame = by_name[name]
        use = (frame.lens, *sizes[photo])
        if use not in made:
            made[use] = frame.lens.make(*sizes[photo])
        camera = made[use]
        key = (camera.model, camera.width, camera.height, *camera.params.tolist())
        camera_id = cameras.setdefault(key, len(cameras) + 1)
        by_id[camera_id] = camera
        images[number] = PosedImage(photo, camera_id, frame.rotation, frame.translation)
    return Reconstruction(by_id, images)


def make_frame(
    file: Path, name: str, lens: Lens, rotation: Array, centre: Array, where: str = ""
) -> PosedFrame:
    """A frame, checked.

    Args:
        name: The photograph's name in the file.
        rotation: The (3, 3) rotation, world to camera in COLMAP's axes, as exact as it is printed.
        centre: The camera's centre (3,) in the world.
        where: What messages call the frame; the name by default.
    """
    name = checked_name(file, name)
    return PosedFrame(name, lens, *checked_pose(file, where or name, rotation, centre))


def checked_pose(file: Path, where: str, rotation: Array, centre: Array) -> tuple[Array, Array]:
    """Rotation and translation, world to camera, from ``make_frame``'s arguments."""
    nearest = checked_rotation(file, where, rotation)
    if not (np.abs(centre) < _MAX_COORDINATE).all():
        raise malformed(file, f"{where}: expected a finite position, found {shown(centre)}")
    return nearest, -nearest @ np.asarray(centre, np.float64)


def checked_rotation(file: Path, where: str, matrix: Array) -> Array:
    """The rotation nearest to ``matrix``."""
    if np.isfinite(matrix).all() and np.abs(matrix).max() < 2:
        u, _, vt = np.linalg.svd(matrix)
        nearest: Array = u @ vt
        if np.abs(nearest - matrix).max() < _ROTATION_TOLERANCE and np.linalg.det(nearest) > 0:
            return nearest
    fault, fix = rotation_fault(matrix)
    raise malformed(file, f"{where}: {fault}", fix)


def turned(axis: int, degrees: float) -> Array:
    """The rotation by an angle about the axis x, y or z (0, 1 or 2)."""
    return rotation_from_vector(np.radians(degrees) * np.eye(3)[axis])


def checked_camera(
    file: Path, where: str, model: str, width: float, height: float, params: Sequence[float]
) -> Camera:
    """A camera with a possible size, a positive focal length and finite parameters."""
    if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE):
        raise malformed(file, f"{where}: impossible image size {width:g}x{height:g}")
    camera = Camera(model, round(width), round(height), np.array(params, np.float64))
    assert len(camera.params) == len(CAMERA_MODELS[model][1]), model
    if not (np.abs(camera.params) < _MAX_COORDINATE).all() or min(camera.pinhole[:2]) <= 0:
        raise malformed(
            file,
            f"{where}: expected finite intrinsics and a positive focal length, found "
            f"{shown(camera.params)}",
        )
    return camera
