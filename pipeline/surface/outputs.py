"""What takes drawing every view: renders, depth maps, a mesh, a video."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb, render_view, to_bytes
from pipeline.runtime.atomic import write_json
from pipeline.runtime.progress import track
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.surface.depth import DepthMaps, Pictures, write_depths, write_renders
from pipeline.surface.files import write_mesh_glb, write_mesh_ply
from pipeline.surface.mesh import build_mesh
from pipeline.surface.path import FPS, camera_path, describe_path
from pipeline.surface.video import write_video

DRAWN = frozenset(("renders", "depths", "mesh", "video"))

#: As many views, evenly spread, say how far away the scene is.
_PROBES = 8


class Told(NamedTuple):
    """What there is to say of the outputs."""

    decisions: list[str]
    warnings: list[str]


def write_drawn(
    out: Path,
    formats: Collection[str],
    gaussians: Gaussians,
    views: list[View],
    options: RasterOptions,
    *,
    up: NDArray[np.float64],
    mesh_voxel: float | None,
) -> Told:
    """Write those of ``renders/``, ``depths/``, ``mesh.ply`` with ``mesh.glb``, and the video with
    ``path.json`` that ``formats`` names.

    Args:
        views: all of them, at the size to draw.
        options: how they are drawn (``Protocol.options``).
        up: (3,) the world's up.
        mesh_voxel: world unit; None chooses.
    """
    told = Told([], [])
    if not {"renders", "depths", "mesh"}.isdisjoint(formats):
        with TemporaryDirectory(prefix="drawn-") as folder:
            pictures = Pictures(gaussians, views, options, Path(folder))
            if "renders" in formats:
                write_renders(out / "renders", pictures)
            if "depths" in formats:
                write_depths(out / "depths", pictures)
            if "mesh" in formats:
                _write_mesh(out, DepthMaps(pictures), up, mesh_voxel, options.threads, told)
    if "video" in formats:
        path = camera_path(views, _typical_depth(gaussians, views, options), up)
        write_json(out / "path.json", describe_path(path))
        frames = [
            to_bytes(render_rgb(gaussians, view, options))
            for view in track(path, "drawing the video", len(path), unit="frames")
        ]
        write_video(out, frames, FPS)
    return told


def _write_mesh(
    out: Path,
    depths: DepthMaps,
    up: NDArray[np.float64],
    voxel: float | None,
    threads: int,
    told: Told,
) -> None:
    mesh, grid = build_mesh(depths, voxel, threads)
    if mesh is None or grid is None:
        told.warnings.append("no mesh: the views' depths agree on no surface")
        return
    write_mesh_ply(out / "mesh.ply", mesh)
    write_mesh_glb(out / "mesh.glb", mesh, up)
    told.decisions.append(
        f"mesh: {len(mesh.faces)} triangles from {len(depths)} views, voxels of {grid.voxel:.4g} "
        f"(scene unit), surfaces up to {grid.far:.4g} away"
    )
    if voxel is not None and grid.voxel > voxel:
        told.warnings.append(
            f"export.mesh_voxel: {voxel:.4g} needs too much memory here, took {grid.voxel:.4g}"
        )


def _typical_depth(gaussians: Gaussians, views: list[View], options: RasterOptions) -> float:
    """Median over views of the median depth of the picture's middle."""
    found = []
    for i in np.unique(np.linspace(0, len(views) - 1, _PROBES).round().astype(int)):
        depth = render_view(gaussians, views[i], options).median_depth
        height, width = depth.shape
        middle = depth[height // 3 : height - height // 3, width // 3 : width - width // 3]
        found.append(middle[middle > 0])
    values = np.concatenate(found)
    return float(np.median(values)) if len(values) else 100 * options.near
