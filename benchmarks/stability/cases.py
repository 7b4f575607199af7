"""The cases: one small scene with numerically or formally extreme photographs and poses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.demo.cameras import lens, look_at
from pipeline.demo.render import rays, render
from pipeline.demo.scene import OBJECTS
from pipeline.demo.sensor import srgb, to_bytes
from pipeline.demo.write import DemoSpec, write_demo
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.colmap import read_model, write_model
from pipeline.photos.load import load_rgb
from pipeline.runtime.atomic import write_json
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

Array = NDArray[np.float64]
Pixels = NDArray[Any]
Expected = Literal["same", "works", "error"]

VIEWS, WIDTH, HEIGHT = 20, 200, 150
# The focus of the demo cameras.
MIDDLE = np.array([0.0, 0.0, 0.45])
# The rotation of the rotated world, which is not about a coordinate axis.
TURN = quat_to_rotation(np.array([0.3, -0.7, 0.5, 0.2]))


@dataclass(frozen=True)
class Case:
    """One scene.

    Attributes:
        make: The function that writes the scene into an existing, empty folder. Its second
            argument is the folder of the base scene, with poses and points.
        what: The description for the table.
        expected: One of "same" (the reference's quality within ``__main__.TOLERANCE_DB``), "works"
            (a result with a PSNR of at least ``least``) and "error" (one clear message).
        reference: The case whose quality it should have.
        config: The options beside the tiny run's.
    """

    make: Callable[[Path, Path], None]
    what: str
    expected: Expected = "same"
    reference: str = "posed"
    least: float = 0.0
    config: Mapping[str, Any] = field(default_factory=dict)


def write_room(folder: Path) -> None:
    """The base scene of all cases: PNG, pinhole cameras, poses and points."""
    spec = DemoSpec(
        views=VIEWS, width=WIDTH, height=HEIGHT, format="png", distortion="none", poses="colmap"
    )
    write_demo(folder, spec)


# ---- World frames ----


def similar(model: Reconstruction, scale: float, rotation: Array, shift: Array) -> Reconstruction:
    """The model in the world ``scale * rotation @ x + shift``."""
    images = {}
    for number, image in model.images.items():
        turned = image.rotation @ rotation.T
        centre = scale * rotation @ image.centre + shift
        images[number] = replace(image, rotation=turned, translation=-turned @ centre)
    xyz = scale * model.points.xyz @ rotation.T + shift
    return Reconstruction(model.cameras, images, replace(model.points, xyz=xyz))


def world(
    scale: float = 1.0, shift: float = 0.0, turned: bool = False, text: bool = False
) -> Callable[[Path, Path], None]:
    """Poses and points in another world; ``shift`` is its distance along an oblique direction."""

    def make(folder: Path, room: Path) -> None:
        rotation = TURN if turned else np.eye(3)
        away = shift * np.array([0.6, -0.64, 0.48])
        model = similar(read_model(room / "sparse/0"), scale, rotation, away)
        write_model(folder / "sparse/0", model, text=text)
        shutil.copytree(room / "images", folder / "images")

    return make


def transforms(scale: float, shift: float) -> Callable[[Path, Path], None]:
    """A scene with transforms.json and without points, which the pipeline then triangulates."""

    def make(folder: Path, room: Path) -> None:
        away = shift * np.array([0.6, -0.64, 0.48])
        model = similar(read_model(room / "sparse/0"), scale, np.eye(3), away)
        fx, fy, cx, cy = model.cameras[1].pinhole
        frames = [
            {
                "file_path": f"images/{image.name}",
                "transform_matrix": (
                    np.linalg.inv(image.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
                ).tolist(),
            }
            for image in model.images.values()
        ]
        camera = {"w": WIDTH, "h": HEIGHT, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        write_json(folder / "transforms.json", camera | {"frames": frames})
        shutil.copytree(room / "images", folder / "images")

    return make


# ---- Views ----


def photographs(folder: Path, room: Path) -> None:
    shutil.copytree(room / "images", folder / "images")


def duplicated(given: bool) -> Callable[[Path, Path], None]:
    """Every photograph twice, under two names, with one pose."""

    def make(folder: Path, room: Path) -> None:
        (folder / "images").mkdir()
        model = read_model(room / "sparse/0")
        images = dict(model.images)
        for number, image in model.images.items():
            again = f"again_{image.name}"
            shutil.copy(room / "images" / image.name, folder / "images" / image.name)
            shutil.copy(room / "images" / image.name, folder / "images" / again)
            images[number + VIEWS] = replace(image, name=again)
        if given:
            write_model(folder / "sparse/0", Reconstruction(model.cameras, images, model.points))

    return make


def one_view(given: bool) -> Callable[[Path, Path], None]:
    def make(folder: Path, room: Path) -> None:
        model = read_model(room / "sparse/0")
        image = model.images[1]
        (folder / "images").mkdir()
        shutil.copy(room / "images" / image.name, folder / "images" / image.name)
        if given:
            points = _untracked(model.points, alone=False)
            write_model(folder / "sparse/0", Reconstruction(model.cameras, {1: image}, points))

    return make


def taken(
    centres: Array,
    targets: Array,
    *,
    given: bool,
    focal: float = 1.0,
    told_focal: float | None = None,
    alone: bool = False,
) -> Callable[[Path, Path], None]:
    """Photographs taken from ``centres`` (N, 3) towards ``targets`` (N, 3).

    Args:
        given: Whether poses and the room's points come along.
        focal: The focal length, in units of the room's own.
        told_focal: The focal length that the given cameras say instead, pixels.
        alone: Whether the objects are before black instead of in the room, which ends 3.5 from its
            middle.
    """

    def make(folder: Path, room: Path) -> None:
        fx, fy, cx, cy = lens("none", WIDTH, HEIGHT).pinhole
        camera = Camera("PINHOLE", WIDTH, HEIGHT, np.array([fx * focal, fy * focal, cx, cy]))
        through = rays(camera)
        (folder / "images").mkdir()
        images = {}
        for i, (centre, target) in enumerate(zip(centres, targets, strict=True), 1):
            rotation = look_at(centre, target)
            posed = PosedImage(f"view_{i:03d}.png", 1, rotation, -rotation @ centre)
            light = render(posed, camera, through, OBJECTS, transparent=alone).light
            write(folder / "images" / posed.name, to_bytes(srgb(light)))
            images[i] = posed
        if given:
            if told_focal is not None:
                params = np.array([told_focal, told_focal, cx, cy])
                camera = Camera("PINHOLE", WIDTH, HEIGHT, params)
            points = _untracked(read_model(room / "sparse/0").points, alone)
            write_model(folder / "sparse/0", Reconstruction({1: camera}, images, points))

    return make


def _untracked(points: Points, alone: bool) -> Points:
    """The points, or those on the objects ``alone``, without tracks."""
    x, y, z = points.xyz.T
    kept = (np.hypot(x, y) < 1.4) & (z > 0.02) & (z < 1.1) if alone else np.full(len(points), True)
    nobody = np.zeros(int(kept.sum()) + 1, np.int64), np.zeros(0, np.int64), np.zeros((0, 2))
    return Points(points.xyz[kept], points.rgb[kept], points.error[kept], *nobody)


def ring(radius: float = 2.3, height: float = 1.25, bob: float = 0.3) -> Array:
    """Positions on two thirds of a circle around the objects, (VIEWS, 3)."""
    angle = np.radians(np.arange(VIEWS) * 12.0)
    tall = height + bob * np.sin(3 * angle)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), tall], 1)


def grid() -> Array:
    """Positions in a vertical plane in front of the objects, uneven by a centimetre, (VIEWS, 3)."""
    x, z = np.meshgrid(np.linspace(-1.0, 1.0, 5), np.linspace(0.6, 1.5, 4))
    y = -2.3 + 0.005 * np.random.default_rng(0).standard_normal(x.shape)
    return np.stack([x.ravel(), y.ravel(), z.ravel()], 1)


def spot() -> Array:
    """Equal positions, (VIEWS, 3)."""
    return np.tile([1.9, -1.3, 1.25], (VIEWS, 1))


def about(centres: Array, spread: float = 0.1) -> Array:
    """A target for each camera, near the objects."""
    return MIDDLE + np.random.default_rng(1).uniform(-spread, spread, centres.shape)


# ---- Images ----


def write(path: Path, pixels: Pixels) -> None:
    """Write RGB, RGBA or grey pixels, 8 or 16 bits, in the format of the file name."""
    order = {2: pixels, 3: pixels[..., ::-1]} if pixels.ndim == 3 else {2: pixels}
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        order[3] = pixels[..., [2, 1, 0, 3]]
    if not cv2.imwrite(str(path), np.ascontiguousarray(order[pixels.ndim])):
        raise OSError(f"{path} could not be written")


def pictures(
    change: Callable[[Pixels, int], Pixels], given: bool, suffix: str = ".png"
) -> Callable[[Path, Path], None]:
    """The photographs of the base scene, each changed by ``change(pixels, number)``."""

    def make(folder: Path, room: Path) -> None:
        (folder / "images").mkdir()
        for number, path in enumerate(sorted((room / "images").iterdir())):
            name = path.with_suffix(suffix).name
            write(folder / "images" / name, change(load_rgb(path), number))
        if given:
            shutil.copytree(room / "sparse", folder / "sparse")

    return make


def sixteen_bit(rgb: Pixels, number: int) -> Pixels:
    return rgb.astype(np.uint16) * 257


def grey(rgb: Pixels, number: int) -> Pixels:
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)


def opaque(rgb: Pixels, number: int) -> Pixels:
    return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])


def enlarged(rgb: Pixels, number: int) -> Pixels:
    """8000 x 6000 pixels whose averages are the small image."""
    return rgb.repeat(40, 0).repeat(40, 1)


def shrunk(rgb: Pixels, number: int) -> Pixels:
    return cv2.resize(rgb, (16, 12), interpolation=cv2.INTER_AREA)


def exposed(factor: float, every: int = 1) -> Callable[[Pixels, int], Pixels]:
    """A change that multiplies every n-th photograph by ``factor`` and clips it."""

    def change(rgb: Pixels, number: int) -> Pixels:
        return (
            rgb
            if number % every
            else np.rint(rgb.astype(np.float64) * factor).clip(0, 255).astype(np.uint8)
        )

    return change


def alpha(folder: Path, room: Path) -> None:
    spec = replace(
        DemoSpec(**json.loads((room / "demo.json").read_text())), alpha=True, poses="transforms"
    )
    # The demo requires an empty folder.
    write_demo(folder, spec)
    shutil.rmtree(folder / "sparse_gt")


WORLDS = {
    "posed": Case(world(), "the reference: poses and points given"),
    "scale_1e-4": Case(world(1e-4), "the world x 1e-4"),
    "scale_1e-2": Case(world(1e-2), "the world x 1e-2"),
    "scale_1e2": Case(world(1e2), "the world x 1e2"),
    "scale_1e4": Case(world(1e4), "the world x 1e4"),
    "moved_1e5": Case(world(shift=1e5), "the world moved by 1e5"),
    "moved_1e7": Case(world(shift=1e7, text=True), "moved by 1e7, COLMAP text"),
    "turned": Case(world(turned=True), "the world turned"),
    "small_and_far": Case(world(1e-4, 1e5, True), "x 1e-4, turned, moved by 1e5"),
    "json": Case(transforms(1, 0), "transforms.json, no points", "works", least=20.0),
    "json_1e-4_far": Case(transforms(1e-4, 1e5), "the same x 1e-4, moved by 1e5", reference="json"),
}
# With density control, rounding changes which Gaussians are densified, and results differ as
# between seeds: only without it are world frames comparable to 0.1 dB.
_DENSE = {"experiments": {"train": {"gradient": {"stop_share": 0.7}}}}
_MCMC = {"train": {"density": {"strategy": "mcmc"}}}
WORLDS |= {
    "dense": Case(world(), "density control", "works", least=20.0, config=_DENSE),
    "dense_1e4": Case(world(1e4), "the same x 1e4", "works", least=20.0, config=_DENSE),
    "mcmc": Case(world(), "density by MCMC", "works", least=20.0, config=_MCMC),
    "mcmc_1e-4": Case(world(1e-4), "the same x 1e-4", "works", least=20.0, config=_MCMC),
    "mcmc_1e4": Case(world(1e4), "the same x 1e4", "works", least=20.0, config=_MCMC),
}
VIEW_SETS = {
    "sfm": Case(photographs, "photographs alone, poses from SfM", "works", least=20.0),
    "twice": Case(duplicated(True), "every photograph twice, poses given", "works", least=20.0),
    "twice_sfm": Case(duplicated(False), "every photograph twice, SfM", "works", least=20.0),
    "one_posed": Case(one_view(True), "one view with its pose", "error"),
    "one": Case(one_view(False), "one photograph", "error"),
    "plane_sfm": Case(
        taken(grid(), about(grid()), given=False), "cameras in one plane, SfM", "works", least=20.0
    ),
    "plane": Case(
        taken(grid(), about(grid()), given=True), "cameras in one plane, given", "works", least=20.0
    ),
    "spot": Case(
        taken(spot(), about(spot(), 0.6), given=True),
        "all cameras in one place, poses and points given",
        "works",
        least=20.0,
    ),
    "spot_sfm": Case(
        taken(spot(), about(spot(), 0.6), given=False), "all cameras in one place, SfM", "error"
    ),
}
PICTURES = {
    "16px": Case(pictures(shrunk, True), "16 x 12 pixels, poses given", "works", least=15.0),
    "16px_sfm": Case(pictures(shrunk, False), "16 x 12 pixels, SfM", "error"),
    "8000px": Case(pictures(enlarged, True, ".jpg"), "8000 x 6000 pixels, reduced to 200 x 150"),
    "16bit": Case(pictures(sixteen_bit, True), "16-bit PNG"),
    "opaque": Case(pictures(opaque, True), "PNG with alpha, all opaque"),
    "grey": Case(pictures(grey, True), "grey PNG", "works", least=20.0),
    "grey_sfm": Case(pictures(grey, False), "grey PNG, SfM", "works", least=20.0),
    "alpha": Case(alpha, "the objects alone on transparent ground", "works", least=20.0),
    "dark_sfm": Case(pictures(exposed(1 / 16), False), "values x 1/16, SfM", "error"),
    "dark": Case(
        pictures(exposed(1 / 16), True), "values x 1/16, poses given", "works", least=20.0
    ),
    "bright": Case(
        pictures(exposed(4), True), "values x 4, clipped, poses given", "works", least=15.0
    ),
    "bright_sfm": Case(
        pictures(exposed(4), False), "values x 4, clipped, SfM", "works", least=15.0
    ),
    "mixed": Case(
        pictures(exposed(1 / 4, 3), True), "every third photograph x 1/4", "works", least=20.0
    ),
}
CAMERAS = {
    "wide": Case(
        taken(ring(1.9), about(ring()), given=True, focal=0.25),
        "focal length of 0.19 widths (138 degrees)",
        "works",
        least=15.0,
    ),
    "tele": Case(
        taken(ring(46.0, 25.0, 6.0), about(ring()), given=True, focal=20.0, alone=True),
        "focal length of 16 widths, 20 times as far away",
        "works",
        least=20.0,
    ),
    "told_tiny": Case(
        taken(ring(), about(ring()), given=True, told_focal=0.01),
        "cameras that say 0.01 px of focal length",
        "error",
    ),
    "told_huge": Case(
        taken(ring(), about(ring()), given=True, told_focal=1e9),
        "cameras that say 1e9 px of focal length",
        "error",
    ),
}
CASES: dict[str, Case] = {**WORLDS, **VIEW_SETS, **PICTURES, **CAMERAS}
