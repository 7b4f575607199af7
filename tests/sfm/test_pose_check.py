"""Given poses that follow another convention are refused with its name; right and noisy ones are
used.

The matches are those of synthetic points, so that no photograph is needed.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import pytest

from pipeline.geometry.cameras import Camera
from pipeline.geometry.epipolar import consistent_matches
from pipeline.geometry.rays import pixels as project_rays
from pipeline.geometry.rotations import quat_to_rotation, rotation_from_vector, rotation_to_quat
from pipeline.io.poses.kinds import PoseKind
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from pipeline.sfm.pose_check import matches as pairs
from pipeline.sfm.pose_check.check import PoseCheck, check_poses
from pipeline.sfm.pose_check.conventions import OPENGL
from pipeline.sfm.pose_check.matches import FeatureMatcher

Scene = tuple[Reconstruction, tuple[Photo, ...]]
WIDTH, HEIGHT = 400, 300
PINHOLE = Camera("PINHOLE", WIDTH, HEIGHT, np.array([420.0, 415.0, 205.0, 148.0]))
LENSES = {
    "pinhole": PINHOLE,
    "distorted": Camera(
        "OPENCV", WIDTH, HEIGHT, np.array([420.0, 415.0, 205.0, 148.0, -0.2, 0.05, 1e-3, -1e-3])
    ),
    "fisheye": Camera(
        "OPENCV_FISHEYE", WIDTH, HEIGHT, np.array([150.0, 150, 200, 150, 0.02, -0.01, 0, 0])
    ),
    "panorama": Camera("EQUIRECTANGULAR", 600, 300, np.array([600.0, 300.0])),
}


class SyntheticMatches(FeatureMatcher):
    """Projections of random points, some of them mismatched, instead of matches of photographs.

    Args:
        truth: the right poses, which the photographs show.
        count: number of points.
    """

    def __init__(self, truth: Reconstruction, count: int = 400) -> None:
        super().__init__()
        rng = np.random.default_rng(1)
        points = rng.normal(size=(count, 3)) * [1.0, 0.8, 0.6]
        self._pixels: dict[str, np.ndarray] = {}
        for image in truth.images.values():
            camera = truth.cameras[image.camera_id]
            seen = points @ image.rotation.T + image.translation
            pixels = project_rays(camera, seen / np.linalg.norm(seen, axis=1, keepdims=True))
            inside = (pixels >= 0).all(1) & (pixels <= [camera.width, camera.height]).all(1)
            pixels = pixels + rng.normal(size=pixels.shape) * 0.3
            self._pixels[image.name] = np.where(inside.reshape(-1, 1), pixels, np.nan)

    def _match(self, one: Photo, two: Photo) -> tuple[np.ndarray, np.ndarray]:
        first, second = self._pixels[one.name], self._pixels[two.name].copy()
        second[::8] = np.roll(second[::8], 1, axis=0)
        both = np.isfinite(first).all(1) & np.isfinite(second).all(1)
        return first[both], second[both]


def ring(camera: Camera, count: int = 8, line: bool = False) -> Scene:
    """Cameras around points at the origin, at different heights, or on a line beside them."""
    rng = np.random.default_rng(2)
    images = {}
    for i in range(count):
        angle = 0.22 * i
        centre = 4 * np.array([np.sin(angle), 0.15 * np.sin(3 * angle), -np.cos(angle)])
        target = rng.normal(size=3) * 0.2
        if line:
            centre, target = np.array([0.3 * i - 3, 0.0, -4.0]), np.array([0.3 * i - 3, 0.0, 0.0])
        forward = (target - centre) / np.linalg.norm(target - centre)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        name = f"{i:03}.jpg"
        images[i + 1] = PosedImage(name, 1, rotation, -rotation @ centre)
    photos = tuple(
        Photo(name=i.name, path=i.name, width=camera.width, height=camera.height, digest="")
        for i in images.values()
    )
    return Reconstruction({1: camera}, images), photos


@cache
def consistent(one: bytes, two: bytes, tolerance: float) -> np.ndarray:
    return consistent_matches(*(np.frombuffer(b).reshape(-1, 3) for b in (one, two)), tolerance)


@pytest.fixture(autouse=True)
def verified_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most of the time is the verification of pairs, which many tests have in common."""
    monkeypatch.setattr(
        pairs,
        "consistent_matches",
        lambda one, two, tolerance: consistent(one.tobytes(), two.tobytes(), tolerance),
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring(PINHOLE)


@lru_cache
def matches(count: int = 400) -> SyntheticMatches:
    return SyntheticMatches(ring(PINHOLE)[0], count)


def check(
    scene: Scene, model: Reconstruction, kind: PoseKind = "transforms", count: int = 400
) -> PoseCheck:
    return check_poses(model, scene[1], kind, Path("transforms.json"), matches(count))


def moved(model: Reconstruction, change: Callable[[PosedImage], PosedImage]) -> Reconstruction:
    return replace(model, images={i: change(image) for i, image in model.images.items()})


def posed(image: PosedImage, rotation: np.ndarray, centre: np.ndarray) -> PosedImage:
    return replace(image, rotation=rotation, translation=-rotation @ centre)


def turned(image: PosedImage) -> PosedImage:
    """COLMAP's axes in a file with OpenGL's."""
    return posed(image, OPENGL @ image.rotation, image.centre)


def inverted(image: PosedImage) -> PosedImage:
    """World to camera with OpenGL's axes, read as camera to world."""
    raw = OPENGL @ image.rotation
    return posed(image, OPENGL @ raw.T, OPENGL @ image.translation)


def transposed(image: PosedImage) -> PosedImage:
    return posed(image, OPENGL @ (OPENGL @ image.rotation), image.centre)


def reordered(image: PosedImage) -> PosedImage:
    """The quaternion's numbers x, y, z, w read as w, x, y, z; the translation is kept."""
    quaternion = np.roll(rotation_to_quat(image.rotation), -1)
    return replace(image, rotation=quat_to_rotation(quaternion))


def as_centre(image: PosedImage) -> PosedImage:
    return posed(image, image.rotation, image.translation)


def mirrored(image: PosedImage) -> PosedImage:
    mirror = np.diag([-1.0, 1, 1])
    return posed(image, mirror @ image.rotation @ mirror, mirror @ image.centre)


def shifted(model: Reconstruction) -> Reconstruction:
    names = sorted(image.name for image in model.images.values())
    after = dict(zip(names, [*names[1:], names[0]], strict=True))
    return moved(model, lambda image: replace(image, name=after[image.name]))


def with_focal(model: Reconstruction, factor: float) -> Reconstruction:
    def changed(params: np.ndarray) -> np.ndarray:
        return np.array([*(params[:2] * factor), *params[2:]])

    cameras = {i: replace(c, params=changed(c.params)) for i, c in model.cameras.items()}
    return replace(model, cameras=cameras)


KINDS: tuple[PoseKind, ...] = ("colmap", "transforms", "realitycapture_csv", "opensfm")

MISTAKES: dict[str, tuple[PoseKind, Callable[[Reconstruction], Reconstruction], str]] = {
    "axes": ("transforms", lambda m: moved(m, turned), "camera axes look like COLMAP's"),
    "inverse": ("transforms", lambda m: moved(m, inverted), "look like world to camera"),
    "quaternion": ("colmap", lambda m: moved(m, reordered), "order of the quaternions"),
    "centre": ("transforms", lambda m: moved(m, as_centre), "translations t of world to camera"),
    "mirrored": ("colmap", lambda m: moved(m, mirrored), "mirrored"),
    "shifted": ("colmap", shifted, "each photograph has the pose of the one"),
    "focal": (
        "colmap",
        lambda m: with_focal(m, 2.0),
        "focal length looks like|intrinsics look like",
    ),
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("line", [False, True])
def test_right_poses_are_used(lens: str, line: bool) -> None:
    model, photos = ring(LENSES[lens], line=line)
    matcher = SyntheticMatches(model, 200)
    for kind in KINDS if lens == "pinhole" else KINDS[:1]:
        found = check_poses(model, photos, kind, Path("poses"), matcher)
        assert "agree with" in found.decisions[0] and not found.warnings


@pytest.mark.parametrize("count", [400, 60])
@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_refused_and_named(scene: Scene, name: str, count: int) -> None:
    """Of few matches, a wrong focal length is a warning."""
    kind, change, cause = MISTAKES[name]
    try:
        found = check(scene, change(scene[0]), kind, count)
    except UserError as error:
        assert re.search(cause, str(error))
        assert "poses: trust" in str(error.fix) and error.file
    else:
        assert count == 60 and name == "focal" and re.search(cause, found.warnings[0])


@pytest.mark.parametrize("lens", ["fisheye", "panorama"])
def test_wide_lenses_are_compared(lens: str) -> None:
    model, photos = ring(LENSES[lens])
    matcher = SyntheticMatches(model, 200)
    for name in ("axes", "inverse", "shifted"):
        kind, change, cause = MISTAKES[name]
        with pytest.raises(UserError, match=cause):
            check_poses(change(model), photos, kind, Path("poses"), matcher)


@pytest.mark.parametrize("count", [400, 60])
@pytest.mark.parametrize("degrees", [0.3, 2.0])
def test_noisy_poses_are_used(scene: Scene, degrees: float, count: int) -> None:
    rng = np.random.default_rng(0)

    def noisy(image: PosedImage) -> PosedImage:
        turn = rotation_from_vector(np.radians(degrees) * rng.normal(size=3))
        return posed(image, turn @ image.rotation, image.centre * rng.normal(1.0, 0.01))

    for kind in KINDS[:3:2]:
        check(scene, moved(scene[0], noisy), kind, count)


@pytest.mark.parametrize("count", [400, 60])
def test_random_poses_are_refused_or_called_wrong(scene: Scene, count: int) -> None:
    rng = np.random.default_rng(5)

    def random(image: PosedImage) -> PosedImage:
        return posed(image, quat_to_rotation(rng.normal(size=4)), rng.normal(size=3))

    assert is_noticed(scene, moved(scene[0], random), count)


@pytest.mark.parametrize("count", [400, 60])
def test_cameras_in_one_place_are_refused_or_called_wrong(scene: Scene, count: int) -> None:
    one_place = moved(scene[0], lambda image: posed(image, image.rotation, np.zeros(3)))
    assert is_noticed(scene, one_place, count)


def is_noticed(scene: Scene, model: Reconstruction, count: int) -> bool:
    try:
        found = check(scene, model, count=count)
    except UserError:
        return True
    return any("may be wrong" in warning for warning in found.warnings)


def test_poses_that_cannot_be_compared_are_a_warning(scene: Scene) -> None:
    assert "could not be compared" in check(scene, scene[0], count=8).warnings[0]


def test_a_single_photograph_needs_no_comparison(scene: Scene) -> None:
    found = check_poses(scene[0], scene[1][:1], "colmap", Path("sparse/0"), matches())
    assert "could not be compared" in found.decisions[0] and not found.warnings
