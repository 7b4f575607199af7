"""Reading point clouds of any supported format; the suffix decides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pipeline.io.clouds.e57_points import count_e57, read_e57
from pipeline.io.clouds.las_points import count_las, read_las
from pipeline.io.clouds.ply_points import count_ply, read_ply
from pipeline.io.clouds.sampling import VoxelSampler, thinned
from pipeline.io.clouds.text_points import read_text
from pipeline.io.clouds.values import Chunks, PointCloud, damaged
from pipeline.runtime.isolate import Limits, OverLimitError, ProcessDied, run_limited

# The function that reads a file's points, and the one that reads their number from its header.
_FORMATS: dict[str, tuple[Callable[[Path], Chunks], Callable[[Path], int] | None]] = {
    ".ply": (read_ply, count_ply),
    ".las": (read_las, count_las),
    ".laz": (read_las, count_las),
    ".e57": (read_e57, count_e57),
    ".xyz": (read_text, None),
    ".csv": (read_text, None),
    ".pts": (read_text, None),
}
CLOUD_SUFFIXES = tuple(_FORMATS)
# The limit of memory in bytes; a tenth of them suffices for files of any size.
_MEMORY = 2 << 30
# The least time of a file, and the slowest that its bytes are read: a tenth of the usual speed.
_SECONDS, _BYTES_PER_SECOND = 60, 1 << 20
# Points that are kept of all files together: 27 bytes each.
MAX_POINTS = 1_000_000


def is_cloud(name: str) -> bool:
    """Whether a file has the suffix of a point cloud."""
    return Path(name).suffix.lower() in _FORMATS


def count_points(path: Path) -> int | None:
    """Number of points according to the file's header; None if the format has no such number.

    Raises:
        UserError: a damaged header.
    """
    _, count = _FORMATS[path.suffix.lower()]
    try:
        return count(path) if count else None
    except OSError as error:
        raise damaged(path, f"cannot be read: {error.strerror}") from None


def read_clouds(paths: Sequence[Path], limit: int = MAX_POINTS) -> PointCloud:
    """The points of some files, at most ``limit`` of them, one a voxel.

    Memory is proportional to ``limit``, not to the files. Each file is read in a process of its
    own, with limits of time and memory and without network: native readers crash on damaged files,
    and allocate what headers claim.

    Raises:
        UserError: a file that is damaged or has no point.
    """
    clouds = [_read(path, limit) for path in paths]
    xyz = np.concatenate([cloud.xyz for cloud in clouds])
    kept = thinned(xyz, limit)
    return PointCloud(
        xyz[kept],
        np.concatenate([cloud.rgb for cloud in clouds])[kept],
        np.concatenate([cloud.coloured for cloud in clouds])[kept],
        sum(cloud.num_read for cloud in clouds),
        sum(cloud.num_invalid for cloud in clouds),
    )


def _read(path: Path, limit: int) -> PointCloud:
    try:
        seconds = _SECONDS + path.stat().st_size / _BYTES_PER_SECOND
        return run_limited(Limits(seconds, _MEMORY, network=False), _sampled, path, limit)
    except OSError as error:
        raise damaged(path, f"cannot be read: {error.strerror or error}") from None
    except OverLimitError as error:
        what = str(error).partition(" ")[2]
        raise damaged(path, f"reading it {what}: it is damaged, or made to do so") from None
    except ProcessDied:
        raise damaged(path, "its reader crashed: the file is damaged") from None


def _sampled(path: Path, limit: int) -> PointCloud:
    sampler = VoxelSampler(limit)
    read, _ = _FORMATS[path.suffix.lower()]
    try:
        for chunk in read(path):
            sampler.add(chunk)
    except OSError as error:
        raise damaged(path, f"cannot be read: {error.strerror or error}") from None
    cloud = sampler.result()
    if not len(cloud):
        what = f"expected points, found none with finite coordinates (of {cloud.num_read})"
        raise damaged(path, what)
    return cloud
