"""Writing the demo scene: a folder of photographs with exact ground truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.demo.cameras import FISHEYE_HALF_ANGLE, LENSES, WIDE, lens, orbit
from pipeline.demo.output import (
    Poses,
    in_processes,
    new_scene,
    pick_pixels,
    surface_points,
    transforms,
)
from pipeline.demo.render import Rays, rays, render
from pipeline.demo.scene import OBJECTS, VISITOR, SceneObject
from pipeline.demo.sensor import expose, srgb, to_bytes, write_dng, write_picture
from pipeline.demo.shapes import Sphere
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import write_model
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import usable_cores
from pipeline.runtime.progress import Progress
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

Format = Literal["jpg", "png", "dng"]
Written = tuple[NDArray[np.float32], NDArray[np.uint8]]  # The depth and colours of a view.


@dataclass(frozen=True)
class DemoSpec:
    """The options of the demo scene.

    Attributes:
        views: The number of photographs, in order around the objects.
        width, height: The size of the photographs in pixels.
        format: The format "jpg" (quality 95), "png", or "dng" (a Bayer sensor's RAW).
        distortion: A key of ``pipeline.demo.cameras.LENSES``.
        poses: The poses given as an input: "none", "colmap" (sparse/0) or "transforms" (.json).
        points: Whether sparse/0 has points.
        alpha: Whether the photographs are PNG with the objects alone on a transparent ground.
        masks: Whether the photographs show a moving ball, which masks/ leave out.
        noise: The read noise of RAW files in steps of 14 bits.
        seed: The seed of the camera positions, the points, the noise and the ball.
    """

    views: int = 32
    width: int = 480
    height: int = 360
    format: Format = "jpg"
    distortion: str = "simple_radial"
    poses: Poses = "none"
    points: bool = True
    alpha: bool = False
    masks: bool = False
    noise: float = 0.0
    seed: int = 0

    def check(self) -> None:
        """Raises UserError if options are incompatible."""
        if self.views < 1 or self.width < 16 or self.height < 16:
            raise UserError("the demo needs at least one view of at least 16x16 pixels")
        if self.format not in get_args(Format) or self.poses not in get_args(Poses):
            raise UserError(f"unknown format {self.format!r} or poses {self.poses!r}")
        if self.distortion not in LENSES:
            raise UserError(f"unknown distortion {self.distortion!r}", fix=f"One of {[*LENSES]}.")
        if self.distortion == "equirectangular" and self.width != 2 * self.height:
            raise UserError("a panorama is twice as wide as high", fix="Choose another --size.")
        if self.distortion in WIDE and (self.poses == "colmap" and self.points):
            raise UserError(
                "points of wide lenses are not written", fix="Use --no-points with --poses colmap."
            )
        if self.alpha and self.format != "png":
            raise UserError(f"{self.format} has no alpha", fix="Use --format png with --alpha.")
        if self.alpha and self.masks:
            raise UserError("alpha and masks do not go together", fix="Choose one.")
        if self.format == "dng" and (self.width % 2 or self.height % 2):
            raise UserError("a Bayer mosaic has even sides", fix="Choose an even --size.")


def write_demo(folder: Path, spec: DemoSpec, processes: int | None = 1) -> None:
    """Write the demo scene. The same spec writes the same bytes at any number of processes.

    Inside ``folder``: ``images/``; ``sparse_gt/`` (COLMAP text, the exact cameras of the stored
    pixels); ``depth_gt/*.npy`` (float32 z at pixel centres, 0 where there is nothing);
    ``masks/``, ``sparse/0`` or ``transforms.json`` if asked for; ``demo.json`` (the spec).

    Args:
        processes: The number of views rendered at once; None for one per core.

    Raises:
        UserError: The options do not go together, or ``folder`` holds something else.
    """
    spec.check()
    with new_scene(folder, "demo.json", "demo scene") as work:
        for name in ("images", "depth_gt", *(["masks"] if spec.masks else [])):
            (work / name).mkdir(parents=True)
        _write(work, spec, processes or usable_cores())


def _write(folder: Path, spec: DemoSpec, processes: int) -> None:
    camera, views = _camera(spec), _views(spec)
    progress = Progress("rendering the demo scene", spec.views, "views")
    depths, colours = [], []
    with in_processes(partial(_write_view, folder, spec), spec.views, processes) as written:
        for depth, colour in written:
            depths.append(depth)
            colours.append(colour)
            progress.advance()
    truth = Reconstruction({1: camera}, {i + 1: posed for i, posed in enumerate(views)})
    write_model(folder / "sparse_gt", truth, text=True)
    if spec.poses == "colmap":
        points = _points(truth, depths, colours, spec.seed) if spec.points else Points.empty()
        given = Reconstruction(truth.cameras, truth.images, points)
        write_model(folder / "sparse" / "0", given)
    if spec.poses == "transforms":
        write_json(folder / "transforms.json", transforms(camera, views))
    write_json(folder / "demo.json", asdict(spec))


def _camera(spec: DemoSpec) -> Camera:
    return lens(spec.distortion, spec.width, spec.height)


def _views(spec: DemoSpec) -> list[PosedImage]:
    return orbit([f"view_{i:03d}.{spec.format}" for i in range(spec.views)], spec.seed)


@lru_cache(maxsize=1)
def _rays(spec: DemoSpec) -> Rays:
    """The rays through the camera's pixels, computed once per process."""
    angle = np.pi if WIDE.get(spec.distortion) is None else FISHEYE_HALF_ANGLE
    return rays(_camera(spec), spec.distortion in WIDE, float(angle))


def _write_view(folder: Path, spec: DemoSpec, number: int) -> Written:
    """Render and write one view, and return its depth and colours for the points. The depth is 0 in
    pixels of the visitor or without a surface."""
    camera, posed = _camera(spec), _views(spec)[number]
    objects = (*OBJECTS, _visitor(spec.seed, number, posed)) if spec.masks else OBJECTS
    options = {"transparent": spec.alpha, "visitor": spec.masks}
    seen = render(posed, camera, _rays(spec), objects, **options)
    stem = Path(posed.name).stem
    path = folder / "images" / posed.name
    taken = f"2026:01:01 12:{number // 60 % 60:02d}:{number % 60:02d}"
    colour = to_bytes(srgb(seen.light))
    if spec.format == "dng":
        write_dng(path, expose(seen.light, spec.noise, (spec.seed, number)), taken)
    elif spec.alpha:
        straight = seen.light / np.maximum(seen.coverage, 1e-6)[..., None]
        alpha = to_bytes(seen.coverage)
        colour = to_bytes(srgb(straight)) * (alpha > 0)[..., None]
        write_picture(path, np.dstack([colour, alpha]), taken)
    else:
        write_picture(path, colour, taken, spec.distortion)
    np.save(folder / "depth_gt" / f"{stem}.npy", seen.depth)
    depth = seen.depth
    if spec.masks:
        visited = seen.coverage > 1e-3
        Image.fromarray(np.where(visited, 0, 255).astype(np.uint8)).save(
            folder / "masks" / f"{stem}.png"
        )
        depth = np.where(visited, np.float32(0), depth)
    return depth, colour


def _visitor(seed: int, number: int, posed: PosedImage) -> SceneObject:
    """A ball at a random position in front of the camera, near the image centre."""
    x, y, z = np.random.default_rng([seed, 2, number]).uniform((-0.3, -0.2, 1.0), (0.3, 0.2, 1.3))
    centre = posed.centre + posed.rotation.T @ np.array([x * z, y * z, z])
    return SceneObject(
        Sphere((float(centre[0]), float(centre[1]), float(centre[2])), 0.14), VISITOR
    )


def _points(
    truth: Reconstruction,
    depths: list[NDArray[np.float32]],
    colours: list[NDArray[np.uint8]],
    seed: int,
) -> Points:
    picks = pick_pixels(truth.cameras[1], len(depths), seed)
    rgb = [colour[rows, columns] for colour, (columns, rows) in zip(colours, picks, strict=True)]
    return surface_points(truth, picks, rgb, depths.__getitem__)
