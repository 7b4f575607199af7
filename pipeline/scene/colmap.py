"""COLMAP sparse models, binary and text, read and written with numpy alone.

Layouts: COLMAP's documentation, "Output Format". Only what a ``Reconstruction`` holds is kept:
keypoints that no point uses, and rigs and frames, are dropped (every image keeps its own pose,
which is what ``images.bin`` stores in all versions of the format).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.errors import UserError
from pipeline.scene.model import CAMERA_MODELS, Camera, Points, Posed, Reconstruction

_MODEL_NAMES = {number: name for name, (number, _) in CAMERA_MODELS.items()}
_POINT2D = np.dtype([("xy", "<f8", (2,)), ("point", "<u8")])
_POINT3D = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", (3,)), ("rgb", "u1", (3,)), ("error", "<f8"), ("length", "<u8")]
)
_TRACK = np.dtype([("image", "<u4"), ("index", "<u4")])
_REMEDY = "export the model again from COLMAP (binary or text), or set poses: ignore"


def quat_to_rotation(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4) quaternions wxyz, any positive norm, to (..., 3, 3) rotations."""
    q = np.asarray(quat, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def rotation_to_quat(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3, 3) rotations to (..., 4) unit quaternions wxyz with w >= 0.

    Shepperd's method: of the four rows of q q^T (all linear in R) the one with the largest
    diagonal is normalised, so that nothing small is divided by.
    """
    r = np.asarray(rotation, np.float64)
    m00, m01, m02 = r[..., 0, 0], r[..., 0, 1], r[..., 0, 2]
    m10, m11, m12 = r[..., 1, 0], r[..., 1, 1], r[..., 1, 2]
    m20, m21, m22 = r[..., 2, 0], r[..., 2, 1], r[..., 2, 2]
    rows = [
        [1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01],
        [m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20],
        [m02 - m20, m01 + m10, 1 - m00 + m11 - m22, m12 + m21],
        [m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22],
    ]
    outer = np.stack([np.stack(row, -1) for row in rows], -2)
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), -1)
    q = np.take_along_axis(outer, best[..., None, None], -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    result: NDArray[np.float64] = np.where(q[..., :1] < 0, -q, q)
    return result


def has_model(folder: Path) -> bool:
    """True where ``read_model`` would find a model to read."""
    return _suffix(folder) is not None


def read_model(folder: Path) -> Reconstruction:
    """Read ``cameras``, ``images`` and, where it exists, ``points3D`` from ``folder``.

    Binary files are preferred to text ones, as COLMAP does. Points come sorted by their id.

    Raises:
        UserError: no model, malformed or truncated files, unknown camera models, poses or
            intrinsics that are not finite, images of unknown cameras, tracks of unknown images.
    """
    suffix = _suffix(folder)
    if suffix is None:
        raise UserError(
            "expected a COLMAP model (cameras and images, both .bin or both .txt), found none",
            file=folder,
            fix=_REMEDY,
        )
    binary = suffix == ".bin"
    cameras_file, images_file = folder / f"cameras{suffix}", folder / f"images{suffix}"
    cameras = (_cameras_from_bytes if binary else _cameras_from_text)(cameras_file)
    images, keypoints = (_images_from_bytes if binary else _images_from_text)(images_file, cameras)
    points_file = folder / f"points3D{suffix}"
    if not points_file.exists():
        return Reconstruction(cameras, images)
    table = (_points_from_bytes if binary else _points_from_text)(points_file)
    return Reconstruction(cameras, images, _points(points_file, table, keypoints))


def write_model(folder: Path, model: Reconstruction, *, text: bool = False) -> None:
    """Write ``model`` as a COLMAP model; the same model gives the same bytes.

    Points get the ids 1, 2, ... in their order; an image's keypoints are those of its tracks.
    Observations at unknown pixels are left out, as the format cannot say "unknown". Files of
    another model in ``folder`` are removed.

    Raises:
        ValueError: an image name the format cannot hold.
    """
    suffix = ".txt" if text else ".bin"
    keypoints, tracks = _index_tracks(model)
    for name in (image.name for image in model.images.values()):
        if not name or any(c in name for c in "\0\n\r"):
            raise ValueError(f"a COLMAP model cannot hold the image name {name!r}")
    files = {
        "cameras": (_cameras_to_text if text else _cameras_to_bytes)(model),
        "images": (_images_to_text if text else _images_to_bytes)(model, keypoints),
        "points3D": (_points_to_text if text else _points_to_bytes)(model.points, tracks),
    }
    for stem in ("cameras", "images", "points3D", "rigs", "frames"):
        for other in (".bin", ".txt"):
            (folder / f"{stem}{other}").unlink(missing_ok=True)
    for stem, data in files.items():
        write_bytes(folder / f"{stem}{suffix}", data)


def _suffix(folder: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in ("cameras", "images")):
            return suffix
    return None


# --- what both formats share -------------------------------------------------------------


@dataclass(frozen=True)
class _PointTable:
    """points3D as stored: ids (P,), xyz (P, 3), rgb (P, 3), error (P,), length (P,) and, one
    after another, the tracks' image ids and keypoint indices (M,)."""

    ids: NDArray[np.int64]
    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    error: NDArray[np.float64]
    length: NDArray[np.int64]
    image: NDArray[np.int64]
    index: NDArray[np.int64]


def _camera(file: Path, number: int, name: str, width: int, height: int, p: list[float]) -> Camera:
    names = CAMERA_MODELS[name][1]
    if len(p) != len(names):
        raise UserError(
            f"camera {number}: {name} has {len(names)} parameters ({', '.join(names)}), "
            f"found {len(p)}",
            file=file,
            fix=_REMEDY,
        )
    camera = Camera(name, width, height, np.array(p, np.float64))
    if not (0 < width < 2**31 and 0 < height < 2**31):
        raise UserError(
            f"camera {number}: impossible size {width}x{height}", file=file, fix=_REMEDY
        )
    if not np.isfinite(camera.params).all() or min(camera.pinhole[:2]) <= 0:
        raise UserError(
            f"camera {number}: expected finite parameters and a positive focal length, found {p}",
            file=file,
            fix=_REMEDY,
        )
    return camera


def _posed(file: Path, name: str, camera_id: int, quat: list[float], shift: list[float]) -> Posed:
    q, t = np.array(quat, np.float64), np.array(shift, np.float64)
    norm = float(np.linalg.norm(q)) if np.isfinite(q).all() else math.nan
    if not (1e-12 < norm < 1e12) or not np.isfinite(t).all():
        raise UserError(
            f"image {name}: expected a finite pose, found quaternion {quat}, translation {shift}",
            file=file,
            fix=f"remove {name} from the model, or set poses: ignore",
        )
    return Posed(name, camera_id, quat_to_rotation(q), t)


def _add_image(
    file: Path,
    images: dict[int, Posed],
    cameras: dict[int, Camera],
    number: int,
    image: Posed,
) -> None:
    if image.camera_id not in cameras:
        raise UserError(
            f"image {image.name} belongs to camera {image.camera_id}, which is not in the model",
            file=file,
            fix=_REMEDY,
        )
    if number in images:
        raise UserError(f"image id {number} stands there twice", file=file, fix=_REMEDY)
    images[number] = image


def _points(file: Path, table: _PointTable, keypoints: dict[int, NDArray[np.float64]]) -> Points:
    """Sort by id and look the observations' pixels up."""
    if not np.isfinite(table.xyz).all():
        bad = int(table.ids[~np.isfinite(table.xyz).all(1)][0])
        raise UserError(f"point {bad}: its position is not finite", file=file, fix=_REMEDY)
    xy = np.full((len(table.image), 2), np.nan)
    order = np.argsort(table.image, kind="stable")
    numbers, starts = np.unique(table.image[order], return_index=True)
    for number, start, stop in zip(numbers, starts, [*starts[1:], len(order)], strict=False):
        rows = order[start:stop]
        seen = keypoints.get(int(number))
        if seen is None:
            raise UserError(
                f"a track names image id {number}, which is not in the model",
                file=file,
                fix=_REMEDY,
            )
        known = rows[table.index[rows] < len(seen)]
        xy[known] = seen[table.index[known]]
    by_id = np.argsort(table.ids, kind="stable")
    if len(by_id) and np.any(np.diff(table.ids[by_id]) == 0):
        raise UserError("a point id stands there twice", file=file, fix=_REMEDY)
    length = table.length[by_id]
    old_start = (np.cumsum(table.length) - table.length)[by_id]
    start = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
    rows = np.repeat(old_start - start[:-1], length) + np.arange(start[-1])
    return Points(
        table.xyz[by_id], table.rgb[by_id], table.error[by_id], start, table.image[rows], xy[rows]
    )


def _index_tracks(
    model: Reconstruction,
) -> tuple[dict[int, list[tuple[float, float, int]]], list[list[tuple[int, int]]]]:
    """For writing: (x, y, point id) of each image's keypoints, and each point's track as
    (image id, keypoint index)."""
    points = model.points
    keypoints: dict[int, list[tuple[float, float, int]]] = {number: [] for number in model.images}
    tracks: list[list[tuple[int, int]]] = []
    images, xy = points.track_image_id.tolist(), points.track_xy.tolist()
    starts = points.track_start.tolist()
    for p in range(len(points)):
        track = []
        for row in range(starts[p], starts[p + 1]):
            x, y = xy[row]
            if math.isfinite(x) and math.isfinite(y):
                seen = keypoints[images[row]]
                track.append((images[row], len(seen)))
                seen.append((x, y, p + 1))
        tracks.append(track)
    return keypoints, tracks


# --- binary -------------------------------------------------------------------------------


class _Reader:
    """Little-endian values from a file's bytes; running out of them is a ``UserError``."""

    def __init__(self, file: Path):
        self.file, self.data, self.at = file, file.read_bytes(), 0

    def take(self, layout: str) -> tuple[int | float, ...]:
        start = self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.data, start)

    def skip(self, size: int) -> int:
        if size > len(self.data) - self.at:
            raise UserError(
                f"the file ends too early: {len(self.data)} bytes, expected at least "
                f"{self.at + size}",
                file=self.file,
                fix=f"the copy was probably cut short: copy it again, or {_REMEDY}",
            )
        self.at += size
        return self.at - size

    def count(self, smallest: int) -> int:
        """A number of records of at least ``smallest`` bytes each, all still to come."""
        number = int(self.take("Q")[0])
        self.skip(number * smallest)
        self.at -= number * smallest
        return number

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            end = len(self.data)
        start = self.skip(end + 1 - self.at)
        try:
            return self.data[start:end].decode()
        except UnicodeDecodeError:
            raise UserError(
                f"an image name at byte {start} is not UTF-8", file=self.file, fix=_REMEDY
            ) from None

    def end(self) -> None:
        if self.at != len(self.data):
            raise UserError(
                f"expected {self.at} bytes, found {len(self.data)}: not a COLMAP file, or damaged",
                file=self.file,
                fix=_REMEDY,
            )


def _cameras_from_bytes(file: Path) -> dict[int, Camera]:
    reader = _Reader(file)
    cameras: dict[int, Camera] = {}
    for _ in range(reader.count(48)):
        number, kind, width, height = (int(v) for v in reader.take("IiQQ"))
        if kind not in _MODEL_NAMES:
            raise _unknown_model(file, number, str(kind))
        name = _MODEL_NAMES[kind]
        params = [float(v) for v in reader.take(f"{len(CAMERA_MODELS[name][1])}d")]
        cameras[number] = _camera(file, number, name, width, height, params)
    reader.end()
    return cameras


def _images_from_bytes(
    file: Path, cameras: dict[int, Camera]
) -> tuple[dict[int, Posed], dict[int, NDArray[np.float64]]]:
    reader = _Reader(file)
    images: dict[int, Posed] = {}
    keypoints: dict[int, NDArray[np.float64]] = {}
    for _ in range(reader.count(73)):
        number, *pose, camera_id = reader.take("I7dI")
        posed = _posed(file, reader.name(), int(camera_id), list(pose[:4]), list(pose[4:]))
        _add_image(file, images, cameras, int(number), posed)
        count = reader.count(_POINT2D.itemsize)
        start = reader.skip(count * _POINT2D.itemsize)
        keypoints[int(number)] = np.frombuffer(reader.data, _POINT2D, count, start)["xy"]
    reader.end()
    return images, keypoints


def _points_from_bytes(file: Path) -> _PointTable:
    reader = _Reader(file)
    # Records differ in length by their tracks: find where each starts, then gather at once.
    count = reader.count(_POINT3D.itemsize)
    starts = np.empty(count, np.int64)
    for row in range(count):
        starts[row] = reader.skip(_POINT3D.itemsize)
        (length,) = struct.unpack_from("<Q", reader.data, reader.at - 8)
        reader.skip(length * _TRACK.itemsize)
    reader.end()
    data = np.frombuffer(reader.data, np.uint8)

    def gather(at: NDArray[np.int64], dtype: np.dtype[np.void]) -> NDArray[np.void]:
        if not len(at):
            return np.zeros(0, dtype)
        return sliding_window_view(data, dtype.itemsize)[at].reshape(-1).view(dtype)

    table = gather(starts, _POINT3D)
    length = table["length"].astype(np.int64)
    first = np.repeat(np.cumsum(length) - length, length)
    within = np.arange(len(first)) - first
    at = np.repeat(starts + _POINT3D.itemsize, length) + _TRACK.itemsize * within
    track = gather(at, _TRACK)
    return _PointTable(
        table["id"].astype(np.int64),
        table["xyz"].astype(np.float64),
        table["rgb"].copy(),
        table["error"].astype(np.float64),
        length,
        track["image"].astype(np.int64),
        track["index"].astype(np.int64),
    )


def _cameras_to_bytes(model: Reconstruction) -> bytes:
    out = [struct.pack("<Q", len(model.cameras))]
    for number, camera in sorted(model.cameras.items()):
        kind = CAMERA_MODELS[camera.model][0]
        out.append(struct.pack("<IiQQ", number, kind, camera.width, camera.height))
        out.append(camera.params.astype("<f8").tobytes())
    return b"".join(out)


def _images_to_bytes(
    model: Reconstruction, keypoints: dict[int, list[tuple[float, float, int]]]
) -> bytes:
    out = [struct.pack("<Q", len(model.images))]
    for number, image in sorted(model.images.items()):
        pose = [*rotation_to_quat(image.rotation), *image.translation]
        out.append(struct.pack("<I7dI", number, *pose, image.camera_id))
        out.append(image.name.encode() + b"\0")
        out.append(struct.pack("<Q", len(keypoints[number])))
        out.extend(struct.pack("<ddQ", *seen) for seen in keypoints[number])
    return b"".join(out)


def _points_to_bytes(points: Points, tracks: list[list[tuple[int, int]]]) -> bytes:
    out = [struct.pack("<Q", len(points))]
    for p, track in enumerate(tracks):
        rgb, error = points.rgb[p].tolist(), float(points.error[p])
        out.append(struct.pack("<Q3d3BdQ", p + 1, *points.xyz[p], *rgb, error, len(track)))
        out.extend(struct.pack("<II", *element) for element in track)
    return b"".join(out)


# --- text ---------------------------------------------------------------------------------


def _unknown_model(file: Path, number: int, found: str) -> UserError:
    return UserError(
        f"camera {number}: unknown camera model {found}; known are {', '.join(CAMERA_MODELS)}",
        file=file,
        fix="undistort in COLMAP first (colmap image_undistorter), or set poses: ignore",
    )


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without comments; empty ones stay, they mean "no keypoints"."""
    try:
        text = file.read_bytes().decode()
    except UnicodeDecodeError as error:
        raise UserError(f"expected UTF-8 text: {error}", file=file, fix=_REMEDY) from None
    for number, line in enumerate(text.split("\n"), 1):
        if not line.startswith("#"):
            yield number, line.strip("\r")


def _fields(file: Path, number: int, line: str, types: list[Callable[[str], Any]]) -> list:
    """The line's leading fields, converted; the last type takes the rest of the line."""
    words = line.split(None, len(types) - 1)
    if len(words) == len(types):
        try:
            return [kind(word) for kind, word in zip(types, words, strict=True)]
        except (ValueError, OverflowError):
            pass
    raise UserError(
        f"line {number}: not what a COLMAP {file.name} holds: {line[:80]!r}", file=file, fix=_REMEDY
    )


def _floats(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def _natural(text: str, limit: int = 2**63) -> int:
    value = int(text)
    if not 0 <= value < limit:
        raise ValueError(text)
    return value


def _id(text: str) -> int:
    """An id of a camera or image, 32 bits in the binary format."""
    return _natural(text, 2**32)


def _cameras_from_text(file: Path) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    for line_number, line in _lines(file):
        if not line.strip():
            continue
        number, name, width, height, params = _fields(
            file, line_number, line, [_id, str, _natural, _natural, _floats]
        )
        if name not in CAMERA_MODELS:
            raise _unknown_model(file, number, name)
        cameras[number] = _camera(file, number, name, width, height, params)
    return cameras


def _images_from_text(
    file: Path, cameras: dict[int, Camera]
) -> tuple[dict[int, Posed], dict[int, NDArray[np.float64]]]:
    images: dict[int, Posed] = {}
    keypoints: dict[int, NDArray[np.float64]] = {}
    lines = _lines(file)
    types: list[Callable[[str], Any]] = [_id, *[float] * 7, _id, str.strip]
    for line_number, line in lines:
        if not line.strip():
            continue
        number, *pose, camera_id, name = _fields(file, line_number, line, types)
        posed = _posed(file, name, camera_id, pose[:4], pose[4:])
        _add_image(file, images, cameras, number, posed)
        line_number, line = next(lines, (line_number + 1, ""))
        try:
            keypoints[number] = np.array(_floats(line), np.float64).reshape(-1, 3)[:, :2]
        except ValueError:
            raise UserError(
                f"line {line_number}: expected X Y POINT3D_ID triples, found {line[:80]!r}",
                file=file,
                fix=_REMEDY,
            ) from None
    return images, keypoints


def _points_from_text(file: Path) -> _PointTable:
    rows: list[list] = []
    tracks: list[list[int]] = []
    types: list[Callable[[str], Any]] = [_natural, *[float] * 3, *[_natural] * 3, float]
    for line_number, line in _lines(file):
        words = line.split()
        if not words:
            continue
        try:
            row = [kind(word) for kind, word in zip(types, words[:8], strict=True)]
            track = [_id(word) for word in words[8:]]
            if len(track) % 2 or max(row[4:7]) > 255:
                raise ValueError(line)
        except ValueError:
            raise UserError(
                f"line {line_number}: not what a COLMAP points3D.txt holds: {line[:80]!r}",
                file=file,
                fix=_REMEDY,
            ) from None
        rows.append(row)
        tracks.append(track)
    flat = np.array([v for track in tracks for v in track], np.int64).reshape(-1, 2)
    return _PointTable(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1:4] for row in rows], np.float64).reshape(-1, 3),
        np.array([row[4:7] for row in rows], np.uint8).reshape(-1, 3),
        np.array([row[7] for row in rows], np.float64),
        np.array([len(track) // 2 for track in tracks], np.int64),
        flat[:, 0],
        flat[:, 1],
    )


def _cameras_to_text(model: Reconstruction) -> bytes:
    out = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, camera in sorted(model.cameras.items()):
        params = " ".join(repr(float(v)) for v in camera.params)
        out.append(f"{number} {camera.model} {camera.width} {camera.height} {params}")
    return ("\n".join(out) + "\n").encode()


def _images_to_text(
    model: Reconstruction, keypoints: dict[int, list[tuple[float, float, int]]]
) -> bytes:
    out = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# X, Y, POINT3D_ID ..."]
    for number, image in sorted(model.images.items()):
        pose = [*rotation_to_quat(image.rotation), *image.translation]
        numbers = " ".join(repr(float(v)) for v in pose)
        out.append(f"{number} {numbers} {image.camera_id} {image.name}")
        out.append(" ".join(f"{x!r} {y!r} {point}" for x, y, point in keypoints[number]))
    return ("\n".join(out) + "\n").encode()


def _points_to_text(points: Points, tracks: list[list[tuple[int, int]]]) -> bytes:
    out = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for p, track in enumerate(tracks):
        xyz = " ".join(repr(float(v)) for v in points.xyz[p])
        rgb = " ".join(str(v) for v in points.rgb[p].tolist())
        row = f"{p + 1} {xyz} {rgb} {float(points.error[p])!r}"
        out.append(" ".join([row, *(f"{image} {index}" for image, index in track)]))
    return ("\n".join(out) + "\n").encode()
