"""The scene's point cloud, which the Gaussians are initialised from instead of sparse points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pipeline.io.clouds.files import CLOUD_SUFFIXES, count_points, is_cloud, read_clouds
from pipeline.io.clouds.values import PointCloud
from pipeline.io.names import is_inside
from pipeline.io.posefiles import GivenPoses
from pipeline.io.transforms import read_points_entry
from pipeline.plan.given_poses import GivenModel
from pipeline.plan.scene_folder import SceneFolder
from pipeline.runtime.errors import UserError
from pipeline.runtime.text import is_plain

_STEM = "points"
_NONE = "set init.points_file: none"
IN_POSES = "the frame and unit of the given poses"
IN_PROJECTION = "the projection of gcp_list.txt"


class PointCloudFiles(BaseModel):
    """The files of a scene's point cloud."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    path: str = Field(description="File or folder, relative to the scene folder.")
    files: tuple[str, ...] = Field(description="The files, relative to the scene folder.")
    points: int | None = Field(
        description="Number of points according to the headers; null where a file has no such "
        "number."
    )
    megabytes: float = Field(description="Size of the files, MB.")

    @property
    def text(self) -> str:
        """The number of points and the file's name."""
        what = f"{self.megabytes:g} MB of" if self.points is None else f"{self.points:,} points of"
        many = f" ({len(self.files)} files)" if len(self.files) > 1 else ""
        return f"{what} {self.path}{many}"


def find_point_cloud(
    at: SceneFolder, poses: GivenPoses | None, has_control: bool
) -> PointCloudFiles | None:
    """The scene's point cloud according to ``init.points_file``.

    Args:
        has_control: Whether the scene has ground control points.

    Raises:
        UserError: There are several clouds, the configured cloud does not exist or cannot be
            placed, or a header is damaged.
    """
    folder, wanted = at.path, at.config.init.points_file
    if wanted == "none":
        return None
    path = _found(at, poses) if wanted == "auto" else _configured(folder, wanted)
    if path is None:
        return None
    placed = has_control and at.config.sfm.georeference in ("auto", "gcp")
    if poses is None and not placed:
        what = (
            "the point cloud cannot be placed: poses are estimated in a frame of their own, "
            "without ground control points"
        )
        fix = f"give poses in the frame of the cloud, or gcp_list.txt in its projection, or {_NONE}"
        if wanted != "auto":
            raise UserError(what, file=folder / path, fix=fix)
        at.warnings.append(f"{path} is not used: {what}; {fix}")
        return None
    files = _files(folder, path)
    counts = [
        at.cache.get(
            folder / file,
            "points",
            cast("type[int | None]", int | None),
            partial(count_points, folder / file),
        )
        for file in files
    ]
    size = sum((folder / file).stat().st_size for file in files)
    known = None if None in counts else sum(count or 0 for count in counts)
    return PointCloudFiles(
        path=path, files=files, points=known, megabytes=float(f"{size / 1e6:.3g}")
    )


def read_point_cloud(
    folder: Path,
    cloud: PointCloudFiles,
    poses: GivenPoses | None,
    given: GivenModel | None,
) -> PointCloud:
    """A subsample of the cloud in the scene's world, if poses are given; else as stored.

    Args:
        given: The given poses; None if there are none.

    Raises:
        UserError: See ``read_clouds``.
    """
    read = read_clouds([folder / file for file in cloud.files])
    if poses is None or given is None:
        return read
    xyz = read.xyz
    if poses.kind == "transforms":
        xyz = _transformed(xyz, read_points_entry(folder / poses.path).to_world)
    return replace(read, xyz=given.to_scene(xyz))


def _transformed(xyz: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    if (matrix == np.eye(4)).all():
        return xyz
    # einsum, not a matrix product: BLAS may round differently with the number of threads.
    return np.asarray(np.einsum("ij,nj->ni", matrix[:3, :3], xyz) + matrix[:3, 3])


def _found(at: SceneFolder, poses: GivenPoses | None) -> str | None:
    """The path of ``points.*`` or ``points/``, else of the cloud that the pose file names."""
    found = sorted(
        entry.name
        for entry in at.path.iterdir()
        if (_is_usable(entry) and entry.stem.casefold() == _STEM)
        or (entry.is_dir() and entry.name == _STEM and _files(at.path, entry.name))
    )
    if len(found) > 1:
        raise UserError(
            f"expected one point cloud, found {len(found)}: {', '.join(found[:5])}",
            file=at.path,
            fix=f"remove the others, or set init.points_file: {found[0]}",
        )
    if found or poses is None or poses.kind != "transforms":
        return found[0] if found else None
    return _named(at, poses)


def _named(at: SceneFolder, poses: GivenPoses) -> str | None:
    """The ``ply_file_path`` of transforms.json; adds a warning if the scene lacks the file."""
    source = at.path / poses.path
    if source.is_dir():  # The splits of a synthetic scene name no cloud.
        return None
    name = at.cache.get(
        source,
        "ply_file_path",
        cast("type[str | None]", str | None),
        lambda: read_points_entry(source).path,
    )
    if name is None:
        return None
    if not is_inside(name) or not is_cloud(name) or not (at.path / name).is_file():
        at.warnings.append(
            f"{poses.path}: its ply_file_path is not used: expected a point cloud in the scene "
            f"folder, found {name[:80]}"
        )
        return None
    return name


def _configured(folder: Path, wanted: str) -> str:
    path = folder / wanted
    if not is_inside(wanted) or not path.exists():
        raise UserError(
            f"init.points_file: expected a file or folder in the scene folder, found {wanted!r}",
            file=folder,
            fix=f"put the point cloud into the scene folder, or {_NONE}",
        )
    if not _files(folder, wanted):
        raise UserError(
            f"init.points_file: expected a point cloud ({', '.join(CLOUD_SUFFIXES)})",
            file=path,
            fix=f"convert it, or {_NONE}",
        )
    return PurePosixPath(wanted).as_posix()


def _is_usable(entry: Path) -> bool:
    """Whether this is a cloud with a name that JSON can hold."""
    name = entry.name
    return entry.is_file() and name[0] != "." and is_plain(name) and is_cloud(name)


def _files(folder: Path, path: str) -> tuple[str, ...]:
    """The point clouds at ``path``, a file or a folder, relative to the scene folder."""
    if (folder / path).is_file():
        return (path,) if is_cloud(path) else ()
    names: Sequence[str] = sorted(
        entry.name for entry in (folder / path).iterdir() if _is_usable(entry)
    )
    return tuple(f"{path}/{name}" for name in names)
