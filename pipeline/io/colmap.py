"""Reading and writing COLMAP sparse models, binary and text, without COLMAP.

Layouts: COLMAP's documentation, "Output Format". Keypoints without a point, rigs and frames are
not read: ``images.bin`` stores the pose of every image in all versions of the format.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from pipeline.io import colmap_binary, colmap_text
from pipeline.io.colmap_records import POINT2D, Keypoints, PointTable, Tracks, malformed
from pipeline.runtime.atomic import write_bytes
from pipeline.scene.reconstruction import Points, Reconstruction


def model_files(folder: Path) -> list[Path]:
    """The files ``cameras``, ``images`` and, if it exists, ``points3D`` of the COLMAP model in
    ``folder``: The binary ones, else the text files, as in COLMAP. Empty without a model."""
    for suffix in (".bin", ".txt"):
        files = [folder / f"{stem}{suffix}" for stem in ("cameras", "images", "points3D")]
        if files[0].is_file() and files[1].is_file():
            return [file for file in files if file.is_file()]
    return []


def has_model(folder: Path) -> bool:
    """Whether ``folder`` holds a COLMAP model."""
    return bool(model_files(folder))


def read_model(folder: Path, *, points: bool = True) -> Reconstruction:
    """Read ``cameras``, ``images`` and, if it exists, ``points3D`` from ``folder``.

    Points are sorted by id.

    Args:
        points: Whether to read the points, which take most of the memory and time.

    Raises:
        UserError: No model, malformed or truncated files, unknown camera models, poses or
            intrinsics that are not finite, images of unknown cameras, tracks of unknown images.
    """
    files = model_files(folder)
    if not files:
        raise malformed(
            folder,
            "expected a COLMAP model (cameras and images, both .bin or both .txt), found none",
        )
    form = format_of(files[0])
    cameras = form.read_cameras(files[0])
    images, keypoints = form.read_images(files[1], cameras)
    if not points or len(files) < 3:
        return Reconstruction(cameras, images)
    return Reconstruction(cameras, images, _points(files[2], form.read_points(files[2]), keypoints))


def format_of(file: Path) -> ModuleType:
    """The module that reads a file of a model: binary or text."""
    return colmap_binary if file.suffix == ".bin" else colmap_text


def write_model(folder: Path, model: Reconstruction, *, text: bool = False) -> None:
    """Write ``model`` as a COLMAP model; the same model gives the same bytes.

    Points get the ids 1, 2, ... in their order; an image's keypoints are the observations of its
    points. Observations with unknown pixels are omitted. Files of another model in ``folder`` are
    removed. COLMAP's text reader ends an image name at the first space: use binary files for
    names with spaces.

    Raises:
        ValueError: An image name that the format cannot hold.
    """
    form, suffix = (colmap_text, ".txt") if text else (colmap_binary, ".bin")
    keypoints, tracks = _index_tracks(model)
    for name in (image.name for image in model.images.values()):
        if not name or any(c in name for c in "\0\n\r"):
            raise ValueError(f"a COLMAP model cannot hold the image name {name!r}")
    for stem in ("cameras", "images", "points3D", "rigs", "frames"):
        for other in (".bin", ".txt"):
            (folder / f"{stem}{other}").unlink(missing_ok=True)
    write_bytes(folder / f"cameras{suffix}", form.cameras_bytes(model))
    write_bytes(folder / f"images{suffix}", form.images_bytes(model, keypoints))
    del keypoints
    write_bytes(folder / f"points3D{suffix}", form.points_bytes(model.points, tracks))


def _points(file: Path, table: PointTable, keypoints: dict[int, NDArray[np.float64]]) -> Points:
    """The points sorted by id, with the pixels of their observations."""
    if not np.isfinite(table.xyz).all():
        bad = int(table.ids[~np.isfinite(table.xyz).all(1)][0])
        raise malformed(file, f"point {bad}: its position is not finite")
    tracks = table.tracks
    xy = np.full((len(tracks.image), 2), np.nan)
    order = np.argsort(tracks.image, kind="stable")
    numbers, starts = np.unique(tracks.image[order], return_index=True)
    for number, start, stop in zip(numbers, starts, [*starts[1:], len(order)], strict=False):
        rows = order[start:stop]
        seen = keypoints.get(int(number))
        if seen is None:
            raise malformed(file, f"a track refers to image id {number}, which is not in the model")
        known = rows[tracks.index[rows] < len(seen)]
        xy[known] = seen[tracks.index[known]]
    by_id = np.argsort(table.ids, kind="stable")
    if len(by_id) and np.any(np.diff(table.ids[by_id]) == 0):
        raise malformed(file, "expected unique point ids, found one twice")
    length = tracks.length[by_id]
    old_start = (np.cumsum(tracks.length) - tracks.length)[by_id]
    start = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
    rows = np.repeat(old_start - start[:-1], length) + np.arange(start[-1])
    return Points(
        table.xyz[by_id], table.rgb[by_id], table.error[by_id], start, tracks.image[rows], xy[rows]
    )


def _index_tracks(model: Reconstruction) -> tuple[Keypoints, Tracks]:
    """The images' keypoints and, as indices of these, the points' tracks."""
    points = model.points
    rows = np.flatnonzero(np.isfinite(points.track_xy).all(axis=1))
    owner = np.repeat(np.arange(len(points)), points.track_length)[rows]
    image = points.track_image_id[rows]
    seen = np.zeros(len(rows), POINT2D)
    seen["xy"], seen["point"] = points.track_xy[rows], owner + 1
    by_image = np.argsort(image, kind="stable")
    numbers, starts = np.unique(image[by_image], return_index=True)
    ends = [*starts[1:].tolist(), len(rows)]
    keypoints: Keypoints = {number: seen[:0] for number in model.images}
    index = np.empty(len(rows), np.int64)
    for number, start, end in zip(numbers.tolist(), starts.tolist(), ends, strict=False):
        of_image = by_image[start:end]
        keypoints[number] = seen[of_image]
        index[of_image] = np.arange(end - start)
    return keypoints, Tracks(np.bincount(owner, minlength=len(points)), image, index)
