"""COLMAP's text model files: reading from files, encoding to bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.geometry.rotations import rotation_to_quat
from pipeline.io.bounded import MIB, read_text
from pipeline.io.colmap_records import (
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

# A thousand photographs take about 300 MiB; larger models are binary.
_MAX_BYTES = 2048 * MIB


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without comments; an empty line is an image without keypoints."""
    text = read_text(file, _MAX_BYTES, fix=REMEDY)
    for number, line in enumerate(text.split("\n"), 1):
        if not line.startswith("#"):
            yield number, line.strip("\r")


def _fields(file: Path, number: int, line: str, types: list[Callable[[str], Any]]) -> list:
    """The line's fields, converted; the last type gets the rest of the line."""
    words = line.split(None, len(types) - 1)
    if len(words) == len(types):
        try:
            return [kind(word) for kind, word in zip(types, words, strict=True)]
        except (ValueError, OverflowError):
            pass
    raise malformed(
        file, f"line {number}: expected a line of a COLMAP {file.name}, found {line[:80]!r}"
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


def read_cameras(file: Path) -> dict[int, Camera]:
    """Camera id -> camera, from ``cameras`` of a model."""
    cameras: dict[int, Camera] = {}
    for line_number, line in _lines(file):
        if not line.strip():
            continue
        number, name, width, height, params = _fields(
            file, line_number, line, [_id, str, _natural, _natural, _floats]
        )
        if name not in CAMERA_MODELS:
            raise unknown_model(file, number, name)
        cameras[number] = make_camera(file, number, name, width, height, params)
    return cameras


def read_images(
    file: Path, cameras: dict[int, Camera]
) -> tuple[dict[int, PosedImage], dict[int, NDArray[np.float64]]]:
    """Image id -> image, and image id -> (K, 2) float64 pixels of its keypoints."""
    images: dict[int, PosedImage] = {}
    keypoints: dict[int, NDArray[np.float64]] = {}
    lines = _lines(file)
    types: list[Callable[[str], Any]] = [_id, *[float] * 7, _id, str.strip]
    for line_number, line in lines:
        if not line.strip():
            continue
        number, *pose, camera_id, name = _fields(file, line_number, line, types)
        posed = make_image(file, name, camera_id, pose[:4], pose[4:])
        add_image(file, images, cameras, number, posed)
        line_number, line = next(lines, (line_number + 1, ""))
        try:
            keypoints[number] = np.array(_floats(line), np.float64).reshape(-1, 3)[:, :2]
        except ValueError:
            raise malformed(
                file, f"line {line_number}: expected X Y POINT3D_ID triples, found {line[:80]!r}"
            ) from None
    return images, keypoints


def image_names(file: Path) -> list[str]:
    """The names of the images in ``images`` of a model, without their poses and keypoints."""
    names = []
    lines = _lines(file)
    types: list[Callable[[str], Any]] = [*[str] * 9, str.strip]
    for number, line in lines:
        if line.strip():
            names.append(_fields(file, number, line, types)[-1])
            next(lines, None)
    return names


def read_points(file: Path) -> PointTable:
    """The content of ``points3D``."""
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
            raise malformed(
                file,
                f"line {line_number}: expected a line of a COLMAP points3D.txt, found "
                f"{line[:80]!r}",
            ) from None
        rows.append(row)
        tracks.append(track)
    flat = np.array([v for track in tracks for v in track], np.int64).reshape(-1, 2)
    return PointTable(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1:4] for row in rows], np.float64).reshape(-1, 3),
        np.array([row[4:7] for row in rows], np.uint8).reshape(-1, 3),
        np.array([row[7] for row in rows], np.float64),
        Tracks(np.array([len(track) // 2 for track in tracks], np.int64), *flat.T),
    )


def cameras_bytes(model: Reconstruction) -> bytes:
    """The content of ``cameras``."""
    out = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, camera in sorted(model.cameras.items()):
        params = " ".join(repr(float(v)) for v in camera.params)
        out.append(f"{number} {camera.model} {camera.width} {camera.height} {params}")
    return ("\n".join(out) + "\n").encode()


def images_bytes(model: Reconstruction, keypoints: Keypoints) -> bytes:
    """The content of ``images``."""
    out = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# X, Y, POINT3D_ID ..."]
    for number, image in sorted(model.images.items()):
        pose = [*rotation_to_quat(image.rotation), *image.translation]
        numbers = " ".join(repr(float(v)) for v in pose)
        out.append(f"{number} {numbers} {image.camera_id} {image.name}")
        of_image = keypoints[number]
        seen = zip(*of_image["xy"].T.tolist(), of_image["point"].tolist(), strict=True)
        out.append(" ".join(f"{x!r} {y!r} {point}" for x, y, point in seen))
    return ("\n".join(out) + "\n").encode()


def points_bytes(points: Points, tracks: Tracks) -> bytes:
    """The content of ``points3D``."""
    out = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    elements = [f"{i} {k}" for i, k in zip(tracks.image, tracks.index, strict=True)]
    ends = np.cumsum(tracks.length).tolist()
    for p, (end, length) in enumerate(zip(ends, tracks.length.tolist(), strict=True)):
        xyz = " ".join(repr(float(v)) for v in points.xyz[p])
        rgb = " ".join(str(v) for v in points.rgb[p].tolist())
        row = f"{p + 1} {xyz} {rgb} {float(points.error[p])!r}"
        out.append(" ".join([row, *elements[end - length : end]]))
    return ("\n".join(out) + "\n").encode()
