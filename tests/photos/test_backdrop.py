"""The background follows from what photographs show: sky, a backdrop, an object that stands alone,
or a scene that fills them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.photos.backdrop import Evidence, SkyMasks, choose_background, measure_evidence
from pipeline.scene.background import SceneBackground
from pipeline.scene.views import View, resized
from tests.splats.test_init import looking_at

SIZE = 96
# As ``looking_at`` holds cameras.
UP = np.array([0.0, 1.0, 0.0])
BLUE, OVERCAST, LAMPLIGHT = (0.4, 0.6, 0.9), (0.9, 0.9, 0.91), (0.9, 0.8, 0.7)
Image = NDArray[np.float64]


def texture(rng: np.random.Generator) -> Image:
    return rng.uniform(0.1, 0.8, (SIZE, SIZE, 3))


def under(colour: tuple[float, float, float]) -> Callable[[np.random.Generator], Image]:
    """Photographs whose upper third has one colour and the noise of a sensor."""

    def draw(rng: np.random.Generator) -> Image:
        image = texture(rng)
        image[: SIZE // 3] = colour + rng.normal(0, 0.003, (SIZE // 3, SIZE, 3))
        return image

    return draw


def before(colour: tuple[float, float, float]) -> Callable[[np.random.Generator], Image]:
    """Photographs of an object in the middle, before a backdrop with noise."""

    def draw(rng: np.random.Generator) -> Image:
        image = np.clip(colour + rng.normal(0, 0.01, (SIZE, SIZE, 3)), 0, 1)
        inner = slice(SIZE // 4, 3 * SIZE // 4)
        image[inner, inner] = texture(rng)[inner, inner]
        return image

    return draw


def scene(
    folder: Path,
    draw: Callable[[np.random.Generator], Image],
    turn: float = 60.0,
    kept: tuple[slice, slice] | None = None,
) -> tuple[list[View], NDArray[np.float64]]:
    """Eight photographs, and points at their textured pixels.

    Args:
        draw: A function that returns a photograph.
        turn: The angle in degrees between the first and the last camera.
        kept: The rows and columns that masks keep; None: there are no masks.
    """
    rng = np.random.default_rng(0)
    views, points = [], []
    for i, angle in enumerate(np.radians(np.linspace(0, turn, 8))):
        centre = 5 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
        view = looking_at(centre, np.zeros(3))
        image = draw(rng)
        file, mask = folder / f"{i}.png", None
        cv2.imwrite(str(file), np.rint(255 * image[..., ::-1]))
        if kept is not None:
            valid = np.zeros((SIZE, SIZE), np.uint8)
            valid[kept] = 255
            mask = str(folder / f"{i}.mask.png")
            cv2.imwrite(mask, valid)
        focal = 1.2 * SIZE
        camera = replace(resized(view, SIZE, SIZE), fx=focal, fy=focal, cx=SIZE / 2, cy=SIZE / 2)
        views.append(replace(camera, name=f"{i}.png", image=str(file), mask=mask))
        rough = np.abs(np.diff(image.mean(2), axis=0, append=0)) > 0.08
        v, u = np.nonzero(rough)
        ray = np.stack([(u - SIZE / 2) / focal, (v - SIZE / 2) / focal, np.ones(len(u))])
        rotation = view.world_to_camera[:3, :3]
        points.append(centre + (rotation.T @ (4 * ray)).T)
    # Points of one photograph would cover the sky of others: what is near is on the ground.
    xyz = np.concatenate(points)
    return views, xyz[xyz[:, 1] < 0.7]


def background_of(
    folder: Path,
    draw: Callable[[np.random.Generator], Image],
    turn: float = 60.0,
    kept: tuple[slice, slice] | None = None,
) -> SceneBackground:
    """The background of ``scene``."""
    return choose_background(measure_evidence(*scene(folder, draw, turn, kept), UP))


def test_the_sky_reaches_what_is_before_it(tmp_path: Path) -> None:
    """Points on the edge hide no sky beside them."""
    views, xyz = scene(tmp_path, under(BLUE))
    masks = SkyMasks(views, xyz, UP)
    for view in views:
        sky = masks.of(view)
        assert sky.shape == (SIZE, SIZE)
        assert sky[: SIZE // 3].mean() > 0.85 and not sky[SIZE // 3 :].any()


def test_few_photographs_with_a_bright_edge_have_no_sky(tmp_path: Path) -> None:
    views, xyz = scene(tmp_path, texture)
    assert not any(SkyMasks(views, xyz, UP).of(view).any() for view in views)
    (tmp_path / "bright").mkdir()
    bright, _ = scene(tmp_path / "bright", under(OVERCAST))
    masks = SkyMasks([bright[0], *views[1:]], xyz, UP)
    assert not masks.of(bright[0]).any()


@pytest.mark.parametrize(
    ("draw", "expected"),
    [
        (under(BLUE), "skybox"),
        (under(OVERCAST), "skybox"),
        (under(LAMPLIGHT), "fill"),
        (texture, "fill"),
        (before((0.0, 0.0, 0.0)), "black"),
        (before((0.06, 0.05, 0.05)), "black"),
        (before((1.0, 1.0, 1.0)), "white"),
        (before((0.5, 0.5, 0.5)), "skybox"),
    ],
    ids=["blue", "overcast", "lamps", "room", "black", "dark", "white", "grey"],
)
def test_the_background_of_a_scene(
    tmp_path: Path, draw: Callable[[np.random.Generator], Image], expected: str
) -> None:
    assert background_of(tmp_path, draw).background == expected


def test_a_backdrop_needs_cameras_that_turn(tmp_path: Path) -> None:
    """From one side, anything far away has the same colour at the same place."""
    assert background_of(tmp_path, before((0.0, 0.0, 0.0)), turn=10.0).background == "fill"


@pytest.mark.parametrize(
    ("kept", "expected"),
    [
        ((slice(20, 76), slice(20, 76)), "black"),
        ((slice(None), slice(24, None)), "skybox"),
        ((slice(0, 70), slice(None)), "skybox"),
    ],
    ids=["only the object", "without a visitor", "without the photographer's feet"],
)
def test_masks_turn_off_the_sky_only_where_an_object_stands_alone(
    tmp_path: Path, kept: tuple[slice, slice], expected: str
) -> None:
    assert background_of(tmp_path, under(BLUE), kept=kept).background == expected


@pytest.mark.parametrize(
    ("evidence", "expected"),
    [
        (Evidence(), "fill"),
        (Evidence(sky=0.3), "skybox"),
        (Evidence(excluded=0.9, sky=0.3), "black"),
        (Evidence(excluded=0.1, sky=0.3), "skybox"),
        (Evidence(fixed=0.9, turn=5.0, sky=0.3), "skybox"),
        (Evidence(fixed=0.9, turn=90.0, sky=0.3), "black"),
        (Evidence(fixed=0.3, turn=90.0), "fill"),
    ],
)
def test_stronger_evidence_counts_first(evidence: Evidence, expected: str) -> None:
    found = choose_background(evidence)
    assert found.background == expected
    assert expected in found.reason
