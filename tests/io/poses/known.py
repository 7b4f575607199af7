"""A scene of known cameras, the comparison of what a reader makes of it, and hostile files."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import project
from pipeline.geometry.rotations import quat_to_rotation
from pipeline.io.poses.formats import format_of
from pipeline.io.poses.frames import PosedFrame, reconstruct
from pipeline.io.poses.kinds import PoseKind
from pipeline.runtime.errors import UserError
from pipeline.scene.reconstruction import PosedImage, Reconstruction

WIDTH, HEIGHT = 640, 480
UTM = np.array([544_256.7, 5_320_919.9, 512.3])
FLIP_YZ = np.diag([1.0, -1.0, -1.0])


def known_scene(
    camera: Camera, count: int = 4, origin: np.ndarray | None = None, names: str = "p{}.jpg"
) -> Reconstruction:
    """``count`` images with random rotations around ``origin``, a few units apart."""
    rng = np.random.default_rng(7)
    images = {}
    for i in range(count):
        rotation = quat_to_rotation(rng.normal(size=4))
        centre = rng.normal(size=3) * 3 + (0 if origin is None else origin)
        images[i + 1] = PosedImage(names.format(i), 1, rotation, -rotation @ centre)
    return Reconstruction({1: camera}, images)


def opencv(*rest: float) -> Camera:
    params = np.array([500.0, 505.0, 322.5, 237.25, *rest])
    model = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}[len(rest)]
    return Camera(model, WIDTH, HEIGHT, params)


def read(kind: PoseKind, folder: Path) -> Reconstruction:
    """What the registry's format finds and reads in a folder, for all photographs that it lists."""
    entry = format_of(kind)
    path = entry.find(folder)
    assert path is not None, f"no {kind} poses found"
    assert all(file.is_file() for file in entry.files(folder / path))
    facts = entry.summarise(folder / path)
    found = entry.read(folder / path, dict.fromkeys(facts["names"], (WIDTH, HEIGHT)), ())
    used = {found.cameras[image.camera_id].model for image in found.images.values()}
    assert facts["num_images"] == len(found.images) and set(facts["models"]) >= used
    return found


def check_same(found: Reconstruction, known: Reconstruction, pixels: bool = True) -> None:
    """Rotations to 1e-4 degrees, centres to 1e-4 of the scene's size, pixels to 0.05."""
    expected = known.by_name()
    images = found.by_name()
    assert sorted(images) == sorted(expected)
    centres = np.stack([image.centre for image in expected.values()])
    size = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.45, 0.45, 7))
    rays = np.stack([x, y], -1)
    for name, image in expected.items():
        turn = images[name].rotation @ image.rotation.T
        axis = turn - turn.T
        assert np.degrees(np.abs(axis).max()) < 1e-4 and np.trace(turn) > 2, name
        assert np.linalg.norm(images[name].centre - image.centre) < 1e-4 * size, name
        if pixels:
            camera = found.cameras[images[name].camera_id]
            assert (camera.width, camera.height) == (WIDTH, HEIGHT)
            known_camera = known.cameras[image.camera_id]
            np.testing.assert_allclose(
                project(camera, rays), project(known_camera, rays), atol=0.05, err_msg=name
            )


_HOSTILE = [
    *("nan", "-inf", "1e300", "-1e300", "1e999", "9" * 5000, "0", "-1", "1e-320", "", "x"),
    *("../../etc/passwd", "/etc/passwd", "\\ud800", "a" * 2000, "null", "[]", "{}", "true"),
    *("\x00", "\u202e", "<", "&bomb;", '"', "0x10", "1_000", "\uff11\uff12"),
]


@st.composite
def mutated(draw: st.DrawFn, text: str) -> bytes:
    """``text`` with some numbers or words replaced, parts removed or repeated, or bytes added."""
    for _ in range(draw(st.integers(1, 3))):
        tokens = [match.span() for match in re.finditer(r"[^\s<>=\"',:;\[\]{}/]+", text)]
        kind = draw(st.sampled_from(["replace", "replace", "cut", "repeat", "truncate"]))
        if kind == "replace" and tokens:
            start, end = draw(st.sampled_from(tokens))
            text = text[:start] + draw(st.sampled_from(_HOSTILE)) + text[end:]
        else:
            start = draw(st.integers(0, len(text)))
            end = min(len(text), start + draw(st.integers(0, 60)))
            part = {"cut": "", "repeat": 2 * text[start:end]}
            text = (
                text[:start]
                if kind == "truncate"
                else text[:start] + part.get(kind, "") + text[end:]
            )
    data = text.encode("utf-8", "surrogatepass")
    if draw(st.integers(0, 9)) == 0:
        at = draw(st.integers(0, len(data)))
        data = data[:at] + draw(st.binary(min_size=1, max_size=4)) + data[at:]
    return data


def error_or_valid(frames: Callable[[Path], list[PosedFrame]], path: Path) -> None:
    """A reader gives a ``UserError`` that names a file and says what to do, or finite cameras with
    names below the folder or absolute."""
    try:
        found = frames(path)
        sizes = {frame.name: (WIDTH, HEIGHT) for frame in found}
        model = reconstruct(found, sizes)
    except UserError as error:
        assert error.file is not None and error.fix and len(str(error)) < 5000
        str(error).encode()
        return
    for image in model.images.values():
        image.name.encode()
        assert np.isfinite(image.world_to_camera).all() and np.isfinite(image.centre).all()
        np.testing.assert_allclose(image.rotation @ image.rotation.T, np.eye(3), atol=1e-9)
    for camera in model.cameras.values():
        assert np.isfinite(camera.params).all() and min(camera.pinhole[:2]) > 0
        assert camera.width > 0 and camera.height > 0
