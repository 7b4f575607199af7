"""Export formats that need renders of the views: renders, depth maps, a mesh, a video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.config.export import Export
from pipeline.config.video import VideoExport
from pipeline.photos.backdrop import SkyMasks
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb, render_view, to_bytes
from pipeline.runtime.isolate import ProcessDied
from pipeline.runtime.progress import track
from pipeline.scene.exposure import NO_GAINS, ExposureGains
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.surface.depth import DepthMaps, RenderCache, write_depths, write_renders
from pipeline.surface.files import write_mesh_glb, write_mesh_ply
from pipeline.surface.mesh import Mesh, build_mesh
from pipeline.surface.path import camera_path, describe_path
from pipeline.surface.texture import Photographs, TexturedMesh, texture_mesh
from pipeline.surface.tsdf import BLOCK
from pipeline.surface.video import write_video

#: Number of views from which the typical depth is measured.
_DEPTH_VIEWS = 8
_NO_ORIGIN = np.zeros(3)


@dataclass(frozen=True)
class Observed:
    """What is known of the photographs beside the Gaussians.

    Attributes:
        gains: Their exposures.
        dense: The folder of the dense stage; None if it did not run.
        dense_unit: The length of the dense stage's unit in the unit of the Gaussians.
        points: (P, 3) the sparse points in the world of the views. They and multi-view stereo tell
            sky from smooth surfaces; without one of them, nothing is sky.
    """

    gains: ExposureGains = NO_GAINS
    dense: Path | None = None
    dense_unit: float = 1.0
    points: NDArray[np.float64] | None = None


class Made(NamedTuple):
    """A mesh and the side of the voxels that it was made of, world units."""

    mesh: Mesh
    voxel: float


class Messages(NamedTuple):
    """Messages to the user about the outputs."""

    decisions: list[str]
    warnings: list[str]


def write_rendered(
    out: Path,
    config: Export,
    gaussians: Gaussians,
    views: list[View],
    options: RasterOptions,
    *,
    up: NDArray[np.float64],
    origin: NDArray[np.float64] = _NO_ORIGIN,
    num_invented: int = 0,
    observed: Observed | None = None,
) -> Messages:
    """Write the outputs that ``config.formats`` names: ``renders/``, ``depths/``, ``mesh.ply`` and
    ``mesh.glb``, the video and its camera path ``path.json``.

    Args:
        views: All views, at the size to render.
        options: The options of the rasterizer (``Protocol.options``).
        up: (3,) up vector of the world.
        origin: (3,) the world's origin in the world of the exported cameras.
        num_invented: The number of invented Gaussians, the last ones. Only the video shows them.
        observed: What the mesh is made of beside the Gaussians.
    """
    formats, observed = config.formats, observed or Observed()
    messages = Messages([], [])
    if not {"renders", "depths", "mesh"}.isdisjoint(formats):
        with TemporaryDirectory(prefix="renders-") as folder:
            trained = gaussians.first(len(gaussians) - num_invented)
            renders = RenderCache(trained, views, options, Path(folder))
            if "renders" in formats:
                write_renders(out / "renders", renders)
            if "depths" in formats:
                write_depths(out / "depths", renders)
            if "mesh" in formats:
                sky = _sky(observed, views, up, messages)
                maps = DepthMaps(renders, observed.dense, observed.dense_unit, sky)
                made = make_mesh(
                    maps, config.mesh_voxel, config.mesh_faces, options.threads, messages
                )
                if made is not None:
                    write_mesh_ply(out / "mesh.ply", made.mesh)
                    photographs = Photographs(views, observed.gains)
                    textured = make_texture(
                        made, photographs, config.texture_px, options.threads, messages
                    )
                    if textured is not None:
                        write_mesh_glb(out / "mesh.glb", textured, up)
    if "video" in formats:
        _write_video(out, config.video, gaussians, views, options, up, origin, messages)
    return messages


def _sky(
    observed: Observed, views: list[View], up: NDArray[np.float64], messages: Messages
) -> SkyMasks | None:
    """The sky of the training views, of which the user is told."""
    if observed.points is None or observed.dense is None:
        return None
    training = [view for view in views if not view.is_test]
    sky = SkyMasks(training, observed.points, up)
    if len(sky):
        messages.decisions.append(
            f"mesh: what looks like sky in {len(sky)} of {len(training)} photographs, and matches "
            "in none of the others, is left out"
        )
    return sky


def _write_video(
    out: Path,
    config: VideoExport,
    gaussians: Gaussians,
    views: list[View],
    options: RasterOptions,
    up: NDArray[np.float64],
    origin: NDArray[np.float64],
    messages: Messages,
) -> None:
    depth = _typical_depth(gaussians, views, options)
    path = camera_path(views, depth, up, config, origin)
    describe_path(path).write(out)
    frames = (
        to_bytes(render_rgb(gaussians, view, options))
        for view in track(path.views, "rendering the video", len(path.views), unit="frames")
    )
    size = path.views[0].width, path.views[0].height
    encoding = write_video(out / "video.mp4", frames, size, path.fps)
    messages.decisions.append(
        f"video: {path.words}, {path.seconds:g} s at {path.fps} frames per second, "
        f"{size[0]}x{size[1]} pixels, {encoding}"
    )


def make_mesh(
    depths: DepthMaps,
    voxel: float | None,
    count: int | None,
    threads: int,
    messages: Messages,
) -> Made | None:
    """The mesh of the surfaces in depth maps; None, with a warning, if there is none.

    Args:
        voxel, count: The arguments of ``build_mesh``.
        messages: The messages that those about the mesh are added to.
    """
    mesh, grid = build_mesh(depths, voxel, threads, count)
    if mesh is None or grid is None:
        why = "the depth maps of the views contain no common surface"
        if voxel is not None and grid is not None and voxel * BLOCK > grid.far:
            why = (
                f"export.mesh_voxel: voxels of {voxel:.4g} are too large for a scene whose "
                f"surfaces are up to {grid.far:.4g} away; lower it, or leave it out"
            )
        messages.warnings.append(f"no mesh: {why}")
        return None
    messages.decisions.append(
        f"mesh: {len(mesh.faces)} triangles from {len(depths)} views, voxels of {grid.voxel:.4g} "
        f"(scene unit), surfaces up to {grid.far:.4g} away"
    )
    if voxel is not None and grid.voxel > voxel:
        messages.warnings.append(
            f"export.mesh_voxel: voxels of {voxel:.4g} need too much memory, or are far smaller "
            f"than a pixel of the views; used {grid.voxel:.4g}"
        )
    return Made(mesh, grid.voxel)


def make_texture(
    made: Made, photographs: Photographs, most_px: int | None, threads: int, messages: Messages
) -> TexturedMesh | None:
    """The mesh with a texture; None, with a warning, if it cannot be cut into charts.

    Args:
        most_px: The argument of ``texture_mesh``.
        messages: The messages that those about the texture are added to.
    """
    try:
        textured = texture_mesh(made.mesh, photographs, made.voxel, most_px, threads)
    except ProcessDied:
        messages.warnings.append(
            "no mesh.glb: the mesh cannot be cut into charts for a texture; mesh.ply has colours "
            "at its vertices. Another export.mesh_voxel or export.mesh_faces may help"
        )
        return None
    height, width = textured.picture.shape[:2]
    messages.decisions.append(
        f"texture: {width}x{height} pixels from {len(photographs.views)} photographs"
    )
    return textured


def _typical_depth(gaussians: Gaussians, views: list[View], options: RasterOptions) -> float:
    """Median over views of the depths in the central ninth of the image."""
    found = []
    for i in np.unique(np.linspace(0, len(views) - 1, _DEPTH_VIEWS).round().astype(int)):
        depth = render_view(gaussians, views[i], options).median_depth
        height, width = depth.shape
        centre = depth[height // 3 : height - height // 3, width // 3 : width - width // 3]
        found.append(centre[centre > 0])
    values = np.concatenate(found)
    return float(np.median(values)) if len(values) else 100 * options.near
