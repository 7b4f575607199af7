"""The folder, processes and given poses that all writers of synthetic scenes share."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import project, unproject
from pipeline.runtime.atomic import replace_folder
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

Poses = Literal["none", "colmap", "transforms"]
Result = TypeVar("Result")
Pixels = tuple[NDArray[np.int64], NDArray[np.int64]]  # The columns and rows.

POINTS_PER_VIEW = 200
# The relative tolerance of depths for the visibility of a point: depth varies within a pixel.
DEPTH_AGREEMENT = 0.01
# The number of views that a process takes at once: neighbours share what is computed for the first.
MAX_CHUNK = 8


@contextmanager
def new_scene(folder: Path, record: str, kind: str) -> Iterator[Path]:
    """A folder to write to, which replaces ``folder`` when everything is written.

    Args:
        record: The file by which an older scene of the same kind is recognised.
        kind: The content of ``folder`` in words, for the message.

    Raises:
        UserError: ``folder`` holds something else.
    """
    if folder.exists() and any(folder.iterdir()) and not (folder / record).exists():
        raise UserError(
            f"is there already and is no {kind}", file=folder, fix="Choose another folder."
        )
    work = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    try:
        yield work
        replace_folder(work, folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)


@contextmanager
def in_processes(
    function: Callable[[int], Result], count: int, processes: int, chunk: int = 1
) -> Iterator[Iterator[Result]]:
    """Yield the results of ``function`` for 0 to ``count`` - 1, in order.

    Rendering is many short numpy calls, which hold the interpreter's lock: threads would not help.
    Processes are spawned, not forked, because the caller may have started threads.

    Args:
        chunk: The number of consecutive calls that one process takes at once, if there are enough.
    """
    processes = min(processes, count)
    if processes == 1:
        yield map(function, range(count))
        return
    size = max(1, min(chunk, count // processes))
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        yield pool.map(function, range(count), chunksize=size)


def pick_pixels(camera: Camera, views: int, seed: int) -> list[Pixels]:
    """The columns and rows of POINTS_PER_VIEW random pixels of each view."""
    rng = np.random.default_rng([seed, 3])
    size = POINTS_PER_VIEW
    return [
        (rng.integers(0, camera.width, size), rng.integers(0, camera.height, size))
        for _ in range(views)
    ]


def surface_points(
    truth: Reconstruction,
    picks: list[Pixels],
    colours: list[NDArray[np.uint8]],
    depth_of: Callable[[int], NDArray[np.float32]],
) -> Points:
    """Points on the surfaces with exact positions, and the views in which they are visible.

    Args:
        truth: The model of one camera, and the views in order.
        picks: The pixels of each view whose points are taken.
        colours: The (POINTS_PER_VIEW, 3) colours of each view at these pixels.
        depth_of: The function from a view's number to its (H, W) depth; 0 where there is no point.
    """
    camera = truth.cameras[1]
    xyz, rgb = [], []
    for i, posed in enumerate(truth.images.values()):
        column, row = picks[i]
        z = depth_of(i)[row, column].astype(np.float64)
        column, row, colour, z = column[z > 0], row[z > 0], colours[i][z > 0], z[z > 0]
        flat = unproject(camera, np.stack([column + 0.5, row + 0.5], axis=-1))
        local = np.concatenate([flat, np.ones((len(z), 1))], axis=1) * z[:, None]
        xyz.append((local - posed.translation) @ posed.rotation)
        rgb.append(colour)
    points = np.concatenate(xyz)
    owner, image, where = [], [], []
    for i, (number, posed) in enumerate(truth.images.items()):
        index, xy = _visible(camera, posed, points, depth_of(i))
        owner.append(index)
        image.append(np.full(len(index), number, np.int64))
        where.append(xy)
    tracks = np.concatenate(owner)
    order = np.argsort(tracks, kind="stable")
    length = np.bincount(tracks, minlength=len(points))
    kept = length >= 2
    order = order[kept[tracks[order]]]
    return Points(
        xyz=points[kept],
        rgb=np.concatenate(rgb)[kept],
        error=np.zeros(int(kept.sum())),
        track_start=np.concatenate([[0], np.cumsum(length[kept])]).astype(np.int64),
        track_image_id=np.concatenate(image)[order],
        track_xy=np.concatenate(where)[order],
    )


def _visible(
    camera: Camera, posed: PosedImage, points: NDArray[np.float64], depth: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The indices of the points that a view sees, and their (N, 2) pixels."""
    local = points @ posed.rotation.T + posed.translation
    front = local[:, 2] > 0.05
    xy = project(camera, local[:, :2] / np.where(front, local[:, 2], 1.0)[:, None])
    inside = front & np.all((xy >= 0) & (xy < (camera.width, camera.height)), axis=1)
    column, row = np.where(inside[:, None], xy, 0).astype(np.intp).T
    agree = np.abs(depth[row, column] - local[:, 2]) < DEPTH_AGREEMENT * local[:, 2]
    seen = np.flatnonzero(inside & agree)
    return seen, xy[seen]


def transforms(camera: Camera, views: list[PosedImage]) -> dict[str, Any]:
    """The content of nerfstudio's transforms.json: camera to world, x right, y up, z backwards."""
    fx, fy, cx, cy = camera.pinhole
    rest = camera.distortion.tolist()
    fisheye = "FISHEYE" in camera.model
    if camera.is_spherical:
        listed = {"camera_model": camera.model, "w": camera.width, "h": camera.height}
        return {**listed, "frames": _frames(views)}
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    rest += [0.0] * (4 - len(rest))
    return {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        **dict(zip(names, rest, strict=True)),
        "frames": _frames(views),
    }


def _frames(views: list[PosedImage]) -> list[dict[str, Any]]:
    frames = []
    for posed in views:
        pose = np.linalg.inv(posed.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{posed.name}", "transform_matrix": pose.tolist()})
    return frames
