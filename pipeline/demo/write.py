"""Writing the demo scene: a folder of photographs with exact ground truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.demo.cameras import FISHEYE_HALF_ANGLE, LENSES, WIDE, lens, orbit
from pipeline.demo.capture import Conditions, Shot, photographed, shots, withheld
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
from pipeline.demo.sensor import (
    EXPOSURE_TIME,
    MODEL,
    CameraBody,
    expose,
    srgb,
    to_bytes,
    write_dng,
    write_picture,
)
from pipeline.demo.shapes import Sphere
from pipeline.demo.walkers import walkers
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import write_model
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import usable_cores
from pipeline.runtime.progress import Progress
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

Format = Literal["jpg", "png", "dng"]
WITHHELD = "withheld"
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
        seed: The seed of everything random.
        conditions: What differs between the photographs.
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
    conditions: Conditions = field(default_factory=Conditions)

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
        self.conditions.check()
        plain = self.format != "dng" and not (self.alpha or self.masks)
        if self.conditions != Conditions() and (self.distortion in WIDE or not plain):
            raise UserError(
                "photographs differ only as JPEG or PNG without alpha, masks and wide lenses",
                fix="Leave out --alpha, --masks, --format dng and wide lenses.",
            )


def write_demo(folder: Path, spec: DemoSpec, processes: int | None = 1) -> None:
    """Write the demo scene. The same spec writes the same bytes at any number of processes.

    Inside ``folder``: ``images/``; ``sparse_gt/`` (COLMAP text, the exact cameras of the stored
    pixels); ``depth_gt/*.npy`` (float32 z at pixel centres, 0 where there is nothing);
    ``masks/``, ``sparse/0`` or ``transforms.json`` if asked for; ``demo.json`` (the spec). Withheld
    photographs are in ``withheld/``, with ``images/``, ``sparse_gt/`` and ``depth_gt/``.

    Args:
        processes: The number of views rendered at once; None for one per core.

    Raises:
        UserError: The options do not go together, or ``folder`` holds something else.
    """
    spec.check()
    with new_scene(folder, "demo.json", "demo scene") as work:
        folders = ["images", "depth_gt", *(["masks"] if spec.masks else [])]
        if _withheld(spec):
            folders += [f"{WITHHELD}/{name}" for name in folders]
        for name in folders:
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
    arc = _withheld(spec)
    kept = [number for number in range(spec.views) if number not in arc]
    posed = [views[number] for number in kept]
    depths, colours = [depths[number] for number in kept], [colours[number] for number in kept]
    truth = _model(camera, posed)
    write_model(folder / "sparse_gt", truth, text=True)
    if arc:
        hidden = _model(camera, [views[number] for number in arc])
        write_model(folder / WITHHELD / "sparse_gt", hidden, text=True)
    if spec.poses == "colmap":
        points = _points(truth, depths, colours, spec.seed) if spec.points else Points.empty()
        given = Reconstruction(truth.cameras, truth.images, points)
        write_model(folder / "sparse" / "0", given)
    if spec.poses == "transforms":
        write_json(folder / "transforms.json", transforms(camera, posed))
    write_json(folder / "demo.json", asdict(spec))


def _model(camera: Camera, views: list[PosedImage]) -> Reconstruction:
    return Reconstruction({1: camera}, {i + 1: posed for i, posed in enumerate(views)})


def _camera(spec: DemoSpec) -> Camera:
    return lens(spec.distortion, spec.width, spec.height)


def _views(spec: DemoSpec) -> list[PosedImage]:
    return orbit([f"view_{i:03d}.{spec.format}" for i in range(spec.views)], spec.seed)


def _withheld(spec: DemoSpec) -> range:
    return withheld(spec.conditions, spec.views, spec.seed)


@lru_cache(maxsize=1)
def _shots(spec: DemoSpec) -> list[Shot]:
    return shots(spec.conditions, spec.views, spec.seed)


@lru_cache(maxsize=1)
def _rays(spec: DemoSpec) -> Rays:
    """The rays through the camera's pixels, computed once per process."""
    angle = np.pi if WIDE.get(spec.distortion) is None else FISHEYE_HALF_ANGLE
    return rays(_camera(spec), spec.distortion in WIDE, float(angle))


def _write_view(folder: Path, spec: DemoSpec, number: int) -> Written:
    """Render and write one view, and return its depth and colours for the points. The depth is 0 in
    pixels of visitors or without a surface."""
    camera, posed, shot = _camera(spec), _views(spec)[number], _shots(spec)[number]
    visitors: tuple[SceneObject, ...] = ()
    if spec.masks:
        visitors = (_visitor(spec.seed, number, posed),)
    elif shot.walkers:
        visitors = walkers(posed, _rays(spec), spec.seed, number)
    seen = render(
        posed,
        camera,
        _rays(spec),
        (*OBJECTS, *visitors),
        transparent=spec.alpha,
        visitors=len(visitors),
        lit=shot.lit,
    )
    stem = Path(posed.name).stem
    if number in _withheld(spec):
        folder = folder / WITHHELD
    path = folder / "images" / posed.name
    taken = f"2026:01:01 12:{number // 60 % 60:02d}:{number % 60:02d}"
    light = seen.light if shot == Shot() else photographed(seen.light, shot, camera)
    colour = to_bytes(srgb(light))
    if spec.format == "dng":
        write_dng(path, expose(light, spec.noise, (spec.seed, number)), taken)
    elif spec.alpha:
        straight = light / np.maximum(seen.coverage, 1e-6)[..., None]
        alpha = to_bytes(seen.coverage)
        colour = to_bytes(srgb(straight)) * (alpha > 0)[..., None]
        write_picture(path, np.dstack([colour, alpha]), taken)
    else:
        write_picture(path, colour, taken, spec.distortion, _body(shot))
    np.save(folder / "depth_gt" / f"{stem}.npy", seen.depth)
    depth = seen.depth
    if visitors:
        visited = seen.coverage > 1e-3
        depth = np.where(visited, np.float32(0), depth)
        if spec.masks:
            Image.fromarray(np.where(visited, 0, 255).astype(np.uint8)).save(
                folder / "masks" / f"{stem}.png"
            )
    return depth, colour


def _body(shot: Shot) -> CameraBody:
    """The camera body of a photograph. Lenses have bodies of their own."""
    model = MODEL if shot.body == 0 else f"Demo {shot.body + 1}"
    exposure = EXPOSURE_TIME * 2**shot.stops if shot.records_exposure else None
    return CameraBody(model, exposure)


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
