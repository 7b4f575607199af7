"""COLMAP's binary model files: reading from files, encoding to bytes."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.geometry.rotations import rotation_to_quat
from pipeline.io.bounded import read_bounded
from pipeline.io.colmap_records import (
    POINT2D,
    REMEDY,
    Keypoints,
    PointTable,
    Tracks,
    add_image,
    make_camera,
    make_image,
    malformed,
    unknown_model,
)
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

_MODEL_NAMES = {number: name for name, (number, _) in CAMERA_MODELS.items()}
_POINT3D = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", (3,)), ("rgb", "u1", (3,)), ("error", "<f8"), ("length", "<u8")]
)
_TRACK = np.dtype([("image", "<u4"), ("index", "<u4")])
# Number of records that are written at a time.
_RECORDS = 1 << 14


class _Reader:
    """Reads little-endian values; a ``UserError`` if the file ends too early."""

    def __init__(self, file: Path):
        self.file, self.at = file, 0
        self.data = read_bounded(file, fix=REMEDY)

    def unpack(self, layout: str) -> tuple[int | float, ...]:
        start = self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.data, start)

    def skip(self, size: int) -> int:
        """Advance by ``size`` bytes; returns the position before."""
        if size > len(self.data) - self.at:
            raise malformed(
                self.file,
                f"the file ends too early: {len(self.data)} bytes, expected at least "
                f"{self.at + size}",
                fix=f"the copy was probably cut short: copy it again, or {REMEDY}",
            )
        self.at += size
        return self.at - size

    def count(self, smallest: int) -> int:
        """The number of records that follow, of at least ``smallest`` bytes each."""
        number = int(self.unpack("Q")[0])
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
            raise malformed(self.file, f"an image name at byte {start} is not UTF-8") from None

    def check_end(self) -> None:
        if self.at != len(self.data):
            raise malformed(
                self.file,
                f"expected {self.at} bytes, found {len(self.data)}: not a COLMAP file, or damaged",
            )


def read_cameras(file: Path) -> dict[int, Camera]:
    """Camera id -> camera, from ``cameras`` of a model."""
    reader = _Reader(file)
    cameras: dict[int, Camera] = {}
    for _ in range(reader.count(40)):
        number, kind, width, height = (int(v) for v in reader.unpack("IiQQ"))
        if kind not in _MODEL_NAMES:
            raise unknown_model(file, number, str(kind))
        name = _MODEL_NAMES[kind]
        params = [float(v) for v in reader.unpack(f"{len(CAMERA_MODELS[name][1])}d")]
        cameras[number] = make_camera(file, number, name, width, height, params)
    reader.check_end()
    return cameras


def read_images(
    file: Path, cameras: dict[int, Camera]
) -> tuple[dict[int, PosedImage], dict[int, NDArray[np.float64]]]:
    """Image id -> image, and image id -> (K, 2) float64 pixels of its keypoints."""
    reader = _Reader(file)
    images: dict[int, PosedImage] = {}
    keypoints: dict[int, NDArray[np.float64]] = {}
    for _ in range(reader.count(73)):
        number, *pose, camera_id = reader.unpack("I7dI")
        posed = make_image(file, reader.name(), int(camera_id), list(pose[:4]), list(pose[4:]))
        add_image(file, images, cameras, int(number), posed)
        count = reader.count(POINT2D.itemsize)
        start = reader.skip(count * POINT2D.itemsize)
        keypoints[int(number)] = np.frombuffer(reader.data, POINT2D, count, start)["xy"]
    reader.check_end()
    return images, keypoints


def image_names(file: Path) -> list[str]:
    """The names of the images in ``images`` of a model, without their poses and keypoints."""
    reader = _Reader(file)
    names = []
    for _ in range(reader.count(73)):
        reader.skip(struct.calcsize("<I7dI"))
        names.append(reader.name())
        reader.skip(reader.count(POINT2D.itemsize) * POINT2D.itemsize)
    return names


def read_points(file: Path) -> PointTable:
    """The content of ``points3D``."""
    reader = _Reader(file)
    # Records differ in length because of their tracks: find the starts, then gather all at once.
    count = reader.count(_POINT3D.itemsize)
    starts = np.empty(count, np.int64)
    length_at, here, size = struct.Struct("<Q").unpack_from, reader.at, len(reader.data)
    for row in range(count):
        starts[row], here = here, here + _POINT3D.itemsize
        if here <= size:
            here += length_at(reader.data, here - 8)[0] * _TRACK.itemsize
        if here > size:
            break
    reader.skip(here - reader.at)
    reader.check_end()
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
    return PointTable(
        table["id"].astype(np.int64),
        table["xyz"].astype(np.float64),
        table["rgb"].copy(),
        table["error"].astype(np.float64),
        Tracks(length, track["image"].astype(np.int64), track["index"].astype(np.int64)),
    )


def cameras_bytes(model: Reconstruction) -> bytes:
    """The content of ``cameras``."""
    out = [struct.pack("<Q", len(model.cameras))]
    for number, camera in sorted(model.cameras.items()):
        kind = CAMERA_MODELS[camera.model][0]
        out.append(struct.pack("<IiQQ", number, kind, camera.width, camera.height))
        out.append(camera.params.astype("<f8").tobytes())
    return b"".join(out)


def images_bytes(model: Reconstruction, keypoints: Keypoints) -> bytes:
    """The content of ``images``."""
    out = [struct.pack("<Q", len(model.images))]
    for number, image in sorted(model.images.items()):
        pose = [*rotation_to_quat(image.rotation), *image.translation]
        out.append(struct.pack("<I7dI", number, *pose, image.camera_id))
        out.append(image.name.encode() + b"\0")
        out.append(struct.pack("<Q", len(keypoints[number])))
        out.append(keypoints[number].tobytes())
    return b"".join(out)


def points_bytes(points: Points, tracks: Tracks) -> bytes:
    """The content of ``points3D``."""
    table = np.zeros(len(points), _POINT3D)
    table["id"] = np.arange(1, len(points) + 1)
    table["xyz"], table["rgb"] = points.xyz, points.rgb
    table["error"], table["length"] = points.error, tracks.length
    track = np.zeros(len(tracks.image), _TRACK)
    track["image"], track["index"] = tracks.image, tracks.index
    # Each record is followed by its track: compute the position of every byte of both.
    before = np.cumsum(tracks.length) - tracks.length
    starts = np.arange(len(points)) * _POINT3D.itemsize + before * _TRACK.itemsize
    within = np.arange(len(track)) - np.repeat(before, tracks.length)
    ends = np.repeat(starts + _POINT3D.itemsize, tracks.length)
    out = np.empty(table.nbytes + track.nbytes, np.uint8)
    for records, at in ((table, starts), (track, ends + _TRACK.itemsize * within)):
        size = records.dtype.itemsize
        for first in range(0, len(records), _RECORDS):
            some = slice(first, first + _RECORDS)
            values = records[some].view(np.uint8).reshape(-1, size)
            out[at[some, None] + np.arange(size)] = values
    return struct.pack("<Q", len(points)) + out.tobytes()
