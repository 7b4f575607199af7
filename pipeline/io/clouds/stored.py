"""A subsampled point cloud as a file that stages exchange."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from pipeline.io.clouds.values import PointCloud
from pipeline.runtime.atomic import write_bytes

FILE = "cloud.npz"


def write_cloud(folder: Path, cloud: PointCloud) -> None:
    """Write ``cloud.npz``, atomically and deterministically."""
    buffer = io.BytesIO()
    counts = np.array([cloud.num_read, cloud.num_invalid])
    np.savez(buffer, xyz=cloud.xyz, rgb=cloud.rgb, coloured=cloud.coloured, counts=counts)
    write_bytes(folder / FILE, buffer.getvalue())


def read_cloud(folder: Path) -> PointCloud | None:
    """The cloud in ``folder``, None without one."""
    if not (folder / FILE).is_file():
        return None
    with np.load(folder / FILE) as archive:
        counts = archive["counts"].tolist()
        return PointCloud(archive["xyz"], archive["rgb"], archive["coloured"], *counts)
