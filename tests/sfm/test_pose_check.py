"""Given poses that follow another convention are refused with its name; right and noisy ones are
used."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.config.schema import Config
from pipeline.demo.write import DemoSpec, write_demo
from pipeline.geometry.rotations import quat_to_rotation, rotation_from_vector, rotation_to_quat
from pipeline.io.colmap import read_model
from pipeline.io.poses.kinds import PoseKind
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from pipeline.sfm.pose_check.check import PoseCheck, check_poses
from pipeline.sfm.pose_check.conventions import OPENGL

Scene = tuple[Reconstruction, tuple[Photo, ...]]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder = tmp_path_factory.mktemp("poses") / "demo"
    write_demo(folder, DemoSpec(views=20, width=400, height=300), processes=2)
    photos = scan(folder, "demo", Config(), cache=None).manifest.photos
    yield read_model(folder / "sparse_gt"), photos


def check(scene: Scene, model: Reconstruction, kind: PoseKind = "transforms") -> PoseCheck:
    return check_poses(model, scene[1], kind, Path("transforms.json"))


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
        return np.array([params[0] * factor, *params[1:]])

    cameras = {i: replace(c, params=changed(c.params)) for i, c in model.cameras.items()}
    return replace(model, cameras=cameras)


MISTAKES: dict[str, tuple[PoseKind, Callable[[Reconstruction], Reconstruction], str]] = {
    "axes": ("transforms", lambda m: moved(m, turned), "camera axes look like COLMAP's"),
    "inverse": ("transforms", lambda m: moved(m, inverted), "look like world to camera"),
    "quaternion": ("colmap", lambda m: moved(m, reordered), "order of the quaternions"),
    "centre": ("transforms", lambda m: moved(m, as_centre), "translations t of world to camera"),
    "mirrored": ("colmap", lambda m: moved(m, mirrored), "mirrored"),
    "shifted": ("colmap", shifted, "each photograph has the pose of the one"),
    "focal": ("colmap", lambda m: with_focal(m, 2.0), "focal length looks like"),
}


def test_right_poses_are_used(scene: Scene) -> None:
    for kind in ("colmap", "transforms"):
        found = check(scene, scene[0], kind)
        assert "agree with" in found.decisions[0] and not found.warnings


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_refused_and_named(scene: Scene, name: str) -> None:
    kind, change, cause = MISTAKES[name]
    with pytest.raises(UserError, match=cause) as error:
        check(scene, change(scene[0]), kind)
    assert "poses: trust" in str(error.value.fix) and error.value.file


def test_noisy_poses_are_used(scene: Scene) -> None:
    rng = np.random.default_rng(0)

    def noisy(image: PosedImage) -> PosedImage:
        turn = rotation_from_vector(np.radians(1.0) * rng.normal(size=3))
        return posed(image, turn @ image.rotation, image.centre * rng.normal(1.0, 0.01))

    check(scene, moved(scene[0], noisy))


def test_cameras_in_one_place_are_refused_or_called_wrong(scene: Scene) -> None:
    model = moved(scene[0], lambda image: posed(image, image.rotation, np.zeros(3)))
    try:
        found = check(scene, model)
    except UserError as error:
        assert "one place" in str(error)
    else:
        assert found.warnings


def test_few_photographs_are_not_compared(scene: Scene) -> None:
    found = check_poses(scene[0], scene[1][:1], "colmap", Path("sparse/0"))
    assert "could not be compared" in found.decisions[0]
