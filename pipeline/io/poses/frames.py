"""Posed frames, the form in which readers of pose files return them, and checks of their values.

Functions raise a ``UserError`` that names the file for values that no camera can have.
"""

from __future__ import annotations

import json
import posixpath
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.io.names import match_names
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import PosedImage, Reconstruction

Array = NDArray[np.float64]
ListedSplit = Literal["train", "test", "val", "none"]
"""The list of a scene's own split that a frame is in; "none": a frame that is in no list."""

FIX = "export the file again, or set poses: ignore"
# Larger files are no list of cameras.
MAX_BYTES = 256 * 2**20
# Larger coordinates have no use: float64 has less than a millimetre left at 1e12 metres.
_MAX_COORDINATE = 1e12
# Matrices printed with few digits deviate this much from a rotation.
_ROTATION_TOLERANCE = 1e-2
_MAX_SIDE = 1_000_000
_MAX_NAME = 1000


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a frame, which may refer to the photograph's size.

    Attributes:
        model: the camera model of the cameras that ``make`` returns.
        make: the camera for a photograph of a width and height in pixels.
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
        name: the photograph, as in ``PosedImage.name``, or relative to the scene folder
            (``PoseFormat.names``); suffix and leading folders may be missing.
        lens: its intrinsics.
        rotation, translation: world to camera, COLMAP's axes; (3, 3) and (3,) float64.
        mask: file of its mask, relative to the scene folder, or None.
        split: the list of the scene's own split that it is in; None if the scene has no split.
    """

    name: str
    lens: Lens
    rotation: Array
    translation: Array
    mask: str | None = None
    split: ListedSplit | None = None


def reconstruct(
    frames: Iterable[PosedFrame], sizes: Mapping[str, tuple[int, int]]
) -> Reconstruction:
    """The frames whose photographs exist.

    Args:
        sizes: photograph -> width and height in pixels.

    Returns:
        Images named by the keys of ``sizes``, one camera for equal intrinsics, no points.
    """
    by_name: dict[str, PosedFrame] = {}
    for frame in frames:
        by_name.setdefault(frame.name, frame)
    cameras: dict[tuple[Any, ...], int] = {}
    by_id: dict[int, Camera] = {}
    images: dict[int, PosedImage] = {}
    found = match_names(list(by_name), sizes)
    for number, (photo, name) in enumerate(sorted(found.items()), 1):
        frame = by_name[name]
        camera = frame.lens.make(*sizes[photo])
        key = (camera.model, camera.width, camera.height, *camera.params.tolist())
        camera_id = cameras.setdefault(key, len(cameras) + 1)
        by_id[camera_id] = camera
        images[number] = PosedImage(photo, camera_id, frame.rotation, frame.translation)
    return Reconstruction(by_id, images)


def malformed(file: Path, what: str, fix: str = FIX) -> UserError:
    return UserError(what, file=file, fix=fix)


def make_frame(
    file: Path, name: str, lens: Lens, rotation: Array, centre: Array, where: str = ""
) -> PosedFrame:
    """A frame, checked.

    Args:
        name: the photograph's name in the file.
        rotation: (3, 3) world to camera, COLMAP's axes, with the errors of printing.
        centre: (3,) the camera's centre in the world.
        where: for messages; default: the name.
    """
    name = checked_name(file, name)
    return PosedFrame(name, lens, *checked_pose(file, where or name, rotation, centre))


def checked_pose(file: Path, where: str, rotation: Array, centre: Array) -> tuple[Array, Array]:
    """Rotation and translation, world to camera, from ``make_frame``'s arguments."""
    nearest = checked_rotation(file, where, rotation)
    if not (np.abs(centre) < _MAX_COORDINATE).all():
        raise malformed(file, f"{where}: expected a finite position, found {_shown(centre)}")
    return nearest, -nearest @ np.asarray(centre, np.float64)


def checked_rotation(file: Path, where: str, matrix: Array) -> Array:
    """The rotation nearest to ``matrix``."""
    if np.isfinite(matrix).all() and np.abs(matrix).max() < 2:
        u, _, vt = np.linalg.svd(matrix)
        nearest: Array = u @ vt
        if np.abs(nearest - matrix).max() < _ROTATION_TOLERANCE and np.linalg.det(nearest) > 0:
            return nearest
    raise malformed(file, f"{where}: the matrix is not a rotation")


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
            f"{_shown(camera.params)}",
        )
    return camera


def checked_name(file: Path, name: str) -> str:
    """``name`` with "/" between folders and without "." and inner ".."; relative to the folder of
    ``file`` if it is absolute and inside of it."""
    plain = posixpath.normpath(name.replace("\\", "/"))
    shown = name[:80].encode(errors="replace").decode()
    if not name or len(name) > _MAX_NAME or any(len(p) > 240 for p in plain.split("/")):
        raise malformed(file, f"expected the name of a photograph, found {shown!r}")
    if any(ord(c) < 32 or 0xD800 <= ord(c) < 0xE000 for c in name):
        raise malformed(file, f"expected the name of a photograph, found {shown!r}")
    if not posixpath.isabs(plain):
        return plain
    folder = str(file.parent.resolve())
    return posixpath.relpath(plain, folder) if plain.startswith(folder + "/") else plain


def read_text(file: Path) -> str:
    """The file's text (UTF-8, with or without byte order mark)."""
    if file.stat().st_size > MAX_BYTES:
        raise malformed(file, f"expected at most {MAX_BYTES >> 20} MiB")
    try:
        return file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise malformed(file, f"expected UTF-8 text: {error}") from None


def read_json(file: Path) -> Any:
    """The content of a JSON file; integers beyond 64 bits become floats."""
    try:
        return json.loads(read_text(file), parse_int=_integer)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise malformed(file, f"{where}: not valid JSON ({error.msg})") from None
    except RecursionError:
        raise malformed(file, "not valid JSON (nested too deeply)") from None


def _integer(digits: str) -> int | float:
    return int(digits) if len(digits) < 19 else float(digits)


def is_number(value: Any) -> bool:
    """Whether ``value`` is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e300  # False for NaN.


def number(file: Path, where: str, value: Any) -> float:
    """``value``, or the number that it is the text of."""
    try:
        found = float(value) if isinstance(value, str) else value
        if is_number(found):
            return float(found)
    except ValueError:
        pass
    raise malformed(file, f"{where}: expected a finite number, found {_shown(value)}")


def numbers(file: Path, where: str, value: Any, count: int) -> Array:
    """(count,) the numbers of a list or of a text with blanks between them."""
    listed = value.split() if isinstance(value, str) else value
    if not isinstance(listed, list | tuple) or len(listed) != count:
        raise malformed(file, f"{where}: expected {count} numbers, found {_shown(value)}")
    return np.array([number(file, where, entry) for entry in listed])


def _shown(value: Any) -> str:
    text = str(value.tolist() if isinstance(value, np.ndarray) else value)
    return repr(text[:60].encode(errors="replace").decode())
