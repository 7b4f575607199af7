"""Accuracy, completeness and colours of meshes of scenes whose true surface is known.

    python -m benchmarks.surface --size 320x240 --json RECORD.json
    python -m benchmarks.surface --scene town --size 480x320 --views 60 --json RECORD.json

The scene is trained with its exact poses and points, and depths are estimated by multi-view stereo.
Meshes are made from the rendered depths alone and from both, with all triangles of marching cubes
and with fewer, in voxels of one size. They are compared with the true surface, and their renders in
the test views, with colours at the vertices and with a texture (of the fewest triangles), with the
photographs.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.light import Setup, first_of, read_scene, write_world
from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.mesh_accuracy import sample
from benchmarks.record_tables import surface
from benchmarks.results import SurfaceResult
from benchmarks.town.solids import UP
from benchmarks.town.write import TownSpec, write_town
from benchmarks.true_surface import TrueSurface, demo_surface, town_surface
from pipeline.config.schema import Split
from pipeline.config.settled import Background
from pipeline.demo.options import picture_size
from pipeline.metrics.protocol import choose_protocol
from pipeline.mvs.dense import reconstruct
from pipeline.photos.backdrop import SkyMasks
from pipeline.photos.load import load_view
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.runtime.machine import usable_cores
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.surface.depth import DepthMaps, RenderCache
from pipeline.surface.mesh import build_mesh
from pipeline.surface.texture import Photographs, TexturedMesh, bilinear, texture_mesh
from pipeline.surface.triangles import barycentric, draw_triangles
from pipeline.surface.tsdf import camera_space
from pipeline.training.run import TrainingRun
from pipeline.training.scene import SceneData, train_scene

Array = NDArray[np.float64]
Colours = Callable[[NDArray[np.integer], Array], NDArray[np.floating]]

SAMPLES = 200_000
#: The shares of the triangles of marching cubes.
SHARES = (1.0, 0.5, 0.125)


@dataclass(frozen=True)
class Scene:
    """The trained scene.

    Attributes:
        truth: The true surface.
        sky: The town's; the demo scene is a room.
        dense: The folder of the dense stage.
    """

    data: SceneData
    renders: RenderCache
    truth: TrueSurface
    sky: SkyMasks | None
    dense: Path
    train_s: float
    dense_s: float


def write_scene(name: str, setup: Setup, seed: int) -> Path:
    """The folder of the photographs, which are written unless they are there."""
    if name == "demo":
        return write_world(setup, "plain", seed)
    width, height = setup.size
    folder = setup.work / f"town_{setup.views}_{width}x{height}_{seed}"
    if not folder.exists():
        spec = TownSpec(setup.views, width, height, "none", poses="colmap", seed=seed)
        write_town(folder, spec, usable_cores())
    return folder


def prepare(name: str, setup: Setup, folder: Path, seed: int) -> Scene:
    """Train the scene and estimate its depths."""
    photographs = write_scene(name, setup, seed)
    scene = read_scene(photographs)
    # The pipeline chooses these, too: a skybox if photographs show sky.
    background: Background = "skybox" if name == "town" else "black"
    options = setup.options().model_copy(update={"background": background})
    threads = usable_cores()
    training = [view for view in scene.views if not view.is_test]
    start = time.perf_counter()
    run = TrainingRun(options, folder / "training", seed=seed, threads=threads)
    gaussians: Gaussians = train_scene(
        scene, first_of(scene, seed, background), run
    ).result.gaussians
    trained = time.perf_counter()
    for part in ("dense", "scratch"):
        (folder / part).mkdir()
    reconstruct(training, scene.model, folder / "dense", folder / "scratch", threads)
    done = time.perf_counter()
    raster = choose_protocol(scene.views, Split(), options).options(options, threads)
    renders = RenderCache(gaussians, scene.views, raster, folder / "renders")
    truth = demo_surface(scene.views) if name == "demo" else town_surface(photographs, scene.views)
    sky = SkyMasks(training, scene.model.points.xyz, UP) if name == "town" else None
    return Scene(scene, renders, truth, sky, folder / "dense", trained - start, done - trained)


def results(scene: Scene, name: str, size: str, seed: int) -> Iterator[SurfaceResult]:
    """One result for each kind of depths and share of triangles."""
    voxel, threads = None, usable_cores()
    for depths, dense in (("rendered", None), ("both", scene.dense)):
        maps, count = DepthMaps(scene.renders, dense, sky=scene.sky), 10**9
        for share in SHARES:
            start = time.perf_counter()
            mesh, grid = build_mesh(maps, voxel, threads, int(share * count))
            if mesh is None or grid is None:
                raise UserError("the depth maps have no common surface", fix="train longer")
            voxel = grid.voxel
            count = len(mesh.faces) if share == 1 else count
            made = time.perf_counter()
            textured = None
            if share == SHARES[-1]:
                photographs = Photographs(scene.data.views)
                textured = texture_mesh(mesh, photographs, voxel, None, threads)
            points = sample(mesh.vertices.astype(np.float64), mesh.faces, SAMPLES)
            error = scene.truth.distance(points)
            missing, _ = cKDTree(points).query(scene.truth.points)
            found, thin = missing < 2 * voxel, scene.truth.thin
            tests = [view for view in scene.data.views if view.is_test]
            yield SurfaceResult(
                seed=seed,
                pixels=size,
                depths=depths,
                share=share,
                triangles=len(mesh.faces),
                voxel_mm=1000 * voxel,
                vertex_error_mm=1000
                * float(np.median(scene.truth.distance(mesh.vertices.astype(np.float64)))),
                error_mm=1000 * float(np.median(error)),
                p90_mm=1000 * float(np.percentile(error, 90)),
                completeness=float(found.mean()),
                psnr_vertices=psnr_of(
                    mesh.vertices, mesh.faces, vertex_colours(mesh.colors), tests
                ),
                psnr_texture=None if textured is None else _textured(textured, tests),
                texture_px=0 if textured is None else max(textured.picture.shape),
                mesh_s=made - start,
                texture_s=None if textured is None else time.perf_counter() - made,
                train_s=scene.train_s,
                dense_s=scene.dense_s,
                scene=name,
                thin_completeness=float(found[thin].mean()) if thin.any() else None,
            )


def vertex_colours(colors: NDArray[np.uint8]) -> Colours:
    """Colours between those at the vertices."""
    return lambda faces, weights: (colors[faces] * weights[..., None]).sum(axis=1)


def texture_colours(textured: TexturedMesh) -> Colours:
    """Colours of the texture."""
    height, width = textured.picture.shape[:2]

    def colours(faces: NDArray[np.integer], weights: Array) -> NDArray[np.floating]:
        u, v = ((textured.uv[faces] * weights[..., None]).sum(axis=1) * (width, height)).T
        return bilinear(textured.picture, u, v)

    return colours


def _textured(textured: TexturedMesh, views: Sequence[View]) -> float:
    return psnr_of(textured.vertices, textured.faces, texture_colours(textured), views)


def psnr_of(
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    colours: Colours,
    views: Sequence[View],
) -> float:
    """The mean PSNR of renders of a mesh, where they show it, against photographs, dB."""
    found = []
    for view in views:
        picture, shown = render_mesh(view, vertices, faces, colours)
        error = (picture - load_view(view).rgb)[shown]
        found.append(10 * np.log10(255**2 / float((error**2).mean())))
    return float(np.mean(found))


def render_mesh(
    view: View,
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    colours: Colours,
    samples: int = 2,
) -> tuple[Array, NDArray[np.bool_]]:
    """(H, W, 3) render of a mesh, the mean of ``samples``^2 points of a pixel, display values of
    255; and the pixels that it covers, (H, W).

    Args:
        colours: The colours in triangles (N, 3) at barycentric coordinates (N, 3).
    """
    x, y, z = camera_space(view, vertices.astype(np.float64))
    inverse = np.where(z > 1e-9, 1 / np.maximum(z, 1e-9), 0.0)
    xy = np.column_stack([view.fx * x * inverse + view.cx, view.fy * y * inverse + view.cy])
    xy *= samples
    width, height = view.width * samples, view.height * samples
    drawn = draw_triangles(xy, inverse, faces, width, height)
    pixel = np.flatnonzero(drawn.face.ravel() >= 0)
    row, column = np.divmod(pixel, width)
    corners = faces[drawn.face.ravel()[pixel]]
    # Affine in the image, divided by depth: perspective.
    weights = barycentric(xy[corners], np.column_stack([column, row]) + 0.5) * inverse[corners]
    weights /= weights.sum(axis=1, keepdims=True)
    picture = np.zeros((height * width, 3))
    picture[pixel] = colours(corners, weights)
    shape = (view.height, samples, view.width, samples)
    shown = np.asarray((drawn.face >= 0).reshape(shape).all(axis=(1, 3)))
    return picture.reshape(*shape, 3).mean(axis=(1, 3)), shown


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.surface",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--scene", choices=("demo", "town"), default="demo")
    add("--size", type=picture_size, default=(320, 240), metavar="WIDTHxHEIGHT")
    add("--views", type=int, default=32, help="photographs")
    add("--steps", type=int, default=1500)
    add("--gaussians", type=int, default=20_000, help="upper limit of their number")
    add("--seeds", type=int, nargs="+", default=[0], metavar="N")
    add("--work", type=Path, default=Path("build/surface"), help="folder for the photographs")
    add_record_options(parser)
    asked = parser.parse_args(arguments)
    setup = Setup(asked.size, asked.views, asked.steps, asked.gaussians, "none", asked.work)
    size = "{}x{}".format(*asked.size)
    found: list[SurfaceResult] = []
    try:
        facts = measured("surface", asked.note, arguments)
        for seed in asked.seeds:
            with TemporaryDirectory() as folder:
                scene = prepare(asked.scene, setup, Path(folder), seed)
                found += results(scene, asked.scene, size, seed)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    if asked.json is not None:
        write_record(asked.json, facts, found)
    print(surface(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
