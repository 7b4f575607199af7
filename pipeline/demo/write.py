"""Writes the demo scene: a folder of photographs with exact ground truth."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.demo.cameras import FISHEYE_HALF_ANGLE, LENSES, WIDE, lens, orbit
from pipeline.demo.render import Rays, rays, render
from pipeline.demo.scene import OBJECTS, VISITOR, SceneObject
from pipeline.demo.sensor import expose, srgb, to_bytes, write_dng, write_picture
from pipeline.demo.shapes import Sphere
from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import project, unproject
from pipeline.io.colmap import write_model
from pipeline.runtime.atomic import replace_folder, write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import usable_cores
from pipeline.runtime.progress import Progress
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

Format = Literal["jpg", "png", "dng"]
Poses = Literal["none", "colmap", "transforms"]
Written = tuple[NDArray[np.float32], NDArray[np.uint8]]  # a view's depth and colours

POINTS_PER_VIEW = 200
# Relative tolerance of depths for the visibility of a point: depth varies within a pixel.
DEPTH_AGREEMENT = 0.01


@dataclass(frozen=True)
class DemoSpec:
    """Options of the demo scene.

    Attributes:
        views: photographs, in order around the objects.
        width, height: pixels.
        format: "jpg" (quality 95), "png", or "dng" (a Bayer sensor's RAW).
        distortion: a key of ``pipeline.demo.cameras.LENSES``.
        poses: poses given as an input: "none", "colmap" (sparse/0) or "transforms" (.json).
        points: whether sparse/0 has points.
        alpha: PNG with the objects alone on a transparent ground.
        masks: a ball that is elsewhere in each photograph, and masks/ that leave it out.
        noise: read noise of RAW files, in steps of 14 bits.
        seed: another seed, other camera positions.
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
    """Write the demo scene; the same spec writes the same bytes at any number of processes.

    Inside ``folder``: ``images/``; ``sparse_gt/`` (COLMAP text, the exact cameras of the stored
    pixels); ``depth_gt/*.npy`` (float32 z at pixel centres, 0 where there is nothing);
    ``masks/``, ``sparse/0`` or ``transforms.json`` if asked for; ``demo.json`` (the spec).

    Args:
        processes: number of views rendered at once; None is one per core.

    Raises:
        UserError: options that do not go together, or ``folder`` holds something else.
    """
    spec.check()
    if folder.exists() and any(folder.iterdir()) and not (folder / "demo.json").exists():
        raise UserError(
            "is there already and is no demo scene", file=folder, fix="Choose another folder."
        )
    work = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    shutil.rmtree(work, ignore_errors=True)
    for name in ("images", "depth_gt", *(["masks"] if spec.masks else [])):
        (work / name).mkdir(parents=True)
    try:
        _write(work, spec, processes or usable_cores())
        replace_folder(work, folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _write(folder: Path, spec: DemoSpec, processes: int) -> None:
    camera, views = _camera(spec), _views(spec)
    progress = Progress("rendering the demo scene", spec.views, "views")
    depths, colours = [], []
    with _written_views(folder, spec, min(processes, spec.views)) as written:
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
        write_json(folder / "transforms.json", _transforms(camera, views))
    write_json(folder / "demo.json", asdict(spec))


@contextmanager
def _written_views(folder: Path, spec: DemoSpec, processes: int) -> Iterator[Iterator[Written]]:
    """Renders and writes all views; yields the results of ``_write_view`` in order.

    Processes, not threads: rendering is many short numpy calls, which hold the interpreter's lock.
    Spawned, not forked: the caller may have started threads.
    """
    write = partial(_write_view, folder, spec)
    if processes == 1:
        yield map(write, range(spec.views))
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        yield pool.map(write, range(spec.views))


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
    """Render and write one view. Its depth and colours are returned for the points; depth is 0
    in pixels of the visitor or without a surface."""
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
    """Points on the surfaces with exact positions, and the views in which they are visible."""
    camera = truth.cameras[1]
    rng = np.random.default_rng([seed, 3])
    xyz, rgb = [], []
    for posed, depth, colour in zip(truth.images.values(), depths, colours, strict=True):
        column = rng.integers(0, camera.width, POINTS_PER_VIEW)
        row = rng.integers(0, camera.height, POINTS_PER_VIEW)
        z = depth[row, column].astype(np.float64)
        column, row, z = column[z > 0], row[z > 0], z[z > 0]
        flat = unproject(camera, np.stack([column + 0.5, row + 0.5], axis=-1))
        local = np.concatenate([flat, np.ones((len(z), 1))], axis=1) * z[:, None]
        xyz.append((local - posed.translation) @ posed.rotation)
        rgb.append(colour[row, column])
    points, colour = np.concatenate(xyz), np.concatenate(rgb)
    seen = np.zeros((len(points), len(depths)), bool)
    where = np.zeros((len(points), len(depths), 2))
    for i, (posed, depth) in enumerate(zip(truth.images.values(), depths, strict=True)):
        local = points @ posed.rotation.T + posed.translation
        front = local[:, 2] > 0.05
        xy = project(camera, local[:, :2] / np.where(front, local[:, 2], 1.0)[:, None])
        inside = front & np.all((xy >= 0) & (xy < (camera.width, camera.height)), axis=1)
        column, row = np.where(inside[:, None], xy, 0).astype(np.intp).T
        agree = np.abs(depth[row, column] - local[:, 2]) < DEPTH_AGREEMENT * local[:, 2]
        seen[:, i], where[:, i] = inside & agree, xy
    kept = seen.sum(axis=1) >= 2
    seen, where = seen[kept], where[kept]
    ids = np.array(list(truth.images), np.int64)
    return Points(
        xyz=points[kept],
        rgb=colour[kept],
        error=np.zeros(int(kept.sum())),
        track_start=np.concatenate([[0], np.cumsum(seen.sum(axis=1))]).astype(np.int64),
        track_image_id=ids[np.nonzero(seen)[1]],
        track_xy=where[seen],
    )


def _transforms(camera: Camera, views: list[PosedImage]) -> dict[str, Any]:
    """nerfstudio's transforms.json: camera to world, x right, y up, z backwards."""
    fx, fy, cx, cy = camera.pinhole
    rest = [float(v) for v in camera.params[len(camera.intrinsics_names) :]]
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
