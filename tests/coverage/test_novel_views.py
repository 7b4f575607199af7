"""Novel views: at free places beside the cameras; what is planted there counts as contradicted,
and what the photographs show does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.coverage.clearing import hides_free_places
from pipeline.coverage.contradictions import NovelViews, compare_novel_views
from pipeline.coverage.novel_views import KINDS, NovelView, choose_novel_views
from pipeline.coverage.probe_views import project
from pipeline.coverage.training_views import render_training_views
from pipeline.demo.cameras import lens, look_at
from pipeline.demo.render import rays, render
from pipeline.demo.scene import OBJECTS
from pipeline.demo.sensor import srgb, to_bytes
from pipeline.render import RasterOptions
from pipeline.scene.reconstruction import PosedImage
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians, concat
from tests.coverage.scenes import UP, camera, renderer, wall

Z_UP = np.array([0.0, 0.0, 1.0])
WIDTH, HEIGHT = 72, 54
WHITE, GREY = 0.5 / 0.2821, 0.0


@dataclass(frozen=True)
class World:
    """The demo scene, as Gaussians on its surfaces, photographed from one side.

    Attributes:
        clean: The novel views of the Gaussians as they are.
    """

    views: list[View]
    gaussians: Gaussians
    clean: NovelViews


def compared(views: list[View], gaussians: Gaussians, threads: int = 2) -> NovelViews:
    options = RasterOptions(threads=threads)
    training = render_training_views(views, renderer(gaussians, threads))
    assert training is not None
    found = compare_novel_views(training, Z_UP, gaussians, options)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    folder = tmp_path_factory.mktemp("photographs")
    optics = lens("none", WIDTH, HEIGHT)
    fx, fy, cx, cy = optics.params
    views, parts = [], []
    for i, angle in enumerate(np.radians(np.arange(-30, 31, 15))):
        centre = np.array([2.4 * np.sin(angle), -2.4 * np.cos(angle), 1.1])
        rotation = look_at(centre, np.array([0.0, 0.0, 0.5]))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
        made = render(PosedImage("", 1, rotation, pose[:3, 3]), optics, rays(optics), OBJECTS)
        colour, file = srgb(made.light), folder / f"{i}.png"
        Image.fromarray(to_bytes(colour)).save(file)
        views.append(View(file.name, str(file), None, WIDTH, HEIGHT, fx, fy, cx, cy, pose, False))
        x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - cx, np.arange(HEIGHT) + 0.5 - cy)
        local = np.stack([x / fx, y / fy, np.ones_like(x)], axis=-1) * made.depth[..., None]
        parts.append(balls(centre + local.reshape(-1, 3) @ rotation, made.depth.ravel() / fx / 2))
        parts[-1].sh[:, 0] = torch.from_numpy((colour.reshape(-1, 3) - 0.5) / 0.2821)
    gaussians = concat(parts)
    return World(views, gaussians, compared(views, gaussians))


def balls(means: np.ndarray, sigma: np.ndarray | float, opacity: float = 0.95) -> Gaussians:
    """Grey balls; ``sigma`` in world units."""
    count = len(means)
    sigmas = np.broadcast_to(np.asarray(sigma, np.float32), count)
    return Gaussians(
        torch.tensor(means, dtype=torch.float32),
        torch.from_numpy(np.log(np.repeat(sigmas[:, None], 3, axis=1))),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        torch.full((count,), float(np.log(opacity / (1 - opacity)))),
        torch.full((count, 1, 3), GREY),
    )


def outside(world: World, points: np.ndarray) -> np.ndarray:
    """The points that lie in no photograph."""
    seen = np.zeros(len(points), bool)
    for view in world.views:
        seen[project(view, points)[0]] = True
    return points[~seen]


def ahead(novel: NovelView, share: float) -> np.ndarray:
    """The point on the optical axis at a share of the distance to the subject."""
    return novel.view.centre + share * novel.distance * novel.view.world_to_camera[2, :3]


def veil(world: World, novel: NovelView) -> Gaussians:
    """A large half transparent white Gaussian in front of the novel view, out of sight."""
    (place,) = outside(world, ahead(novel, 0.2)[None])
    made = balls(place[None], 0.08 * novel.distance, 0.45)
    made.sh[:] = WHITE
    return made


def cloud(world: World, novel: NovelView) -> Gaussians:
    """Small opaque floaters around the novel view, out of sight."""
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (3000, 3)) + ahead(novel, 0.15)
    return balls(outside(world, points), 0.012)


def haze(world: World, novel: NovelView) -> Gaussians:
    """Faint large white Gaussians between the cameras and the surface, in all photographs."""
    points = np.random.default_rng(0).uniform([-1, -1.4, 0.3], [1, -0.9, 1.2], (60, 3))
    made = balls(points, 0.25, 0.08)
    made.sh[:] = WHITE
    return made


def test_the_scene_without_defects_agrees_with_its_photographs(world: World) -> None:
    assert set(world.clean.by_kind()) == set(KINDS)
    assert world.clean.shares[:, 0].max() < 0.02
    assert world.clean.shares[:, 0].mean() < 0.01
    beside = world.clean.by_kind()["beside"][1]
    assert beside[1] > 0.02, "what no photograph shows is unseen"


def plantable(world: World) -> tuple[NovelView, float]:
    """A novel view with room before it that no photograph shows, and its contradicted share."""
    return next(
        (novel, float(share))
        for novel, (share, _) in zip(world.clean.views, world.clean.shares, strict=True)
        if novel.kind == "beside" and len(outside(world, ahead(novel, 0.2)[None]))
    )


@pytest.mark.parametrize(("plant", "least"), [(veil, 0.4), (cloud, 0.4), (haze, 0.2)])
def test_planted_defects_are_contradicted(
    world: World, plant: Callable[[World, NovelView], Gaussians], least: float
) -> None:
    """In a part of the view that they take up, which no rule finds but the one that is for them."""
    novel, before = plantable(world)
    found = compared(world.views, concat([world.gaussians, plant(world, novel)]))
    after = next(
        float(share)
        for other, (share, _) in zip(found.views, found.shares, strict=True)
        if other.kind == "beside" and other.base is novel.base
    )
    assert before < 0.02 and after > least
    assert found.shares[:, 0].mean() > 5 * world.clean.shares[:, 0].mean()


@pytest.mark.parametrize("plant", [veil, cloud])
def test_what_hides_a_free_place_is_removed(
    world: World, plant: Callable[[World, NovelView], Gaussians]
) -> None:
    planted = plant(world, plantable(world)[0])
    gaussians = concat([world.gaussians, planted])
    hiding = hides_free_places(gaussians, world.views, Z_UP, RasterOptions(threads=2))
    # Surfaces stay.
    assert hiding[: len(world.gaussians)].sum() <= 1e-4 * len(world.gaussians)
    kept = gaussians.select(torch.nonzero(~hiding)[:, 0])
    left = compared(world.views, kept).shares[:, 0].mean()
    assert left < 0.1 * compared(world.views, gaussians).shares[:, 0].mean() + 0.005
    alone = hides_free_places(gaussians, world.views, Z_UP, RasterOptions(threads=1))
    assert torch.equal(alone, hiding)


def test_what_photographs_show_near_a_free_place_stays(world: World) -> None:
    """A post that all photographs show, nearer to the cameras than any surface behind it."""
    heights = np.linspace(0.2, 1.4, 40)
    post = balls(np.stack([np.zeros(40), np.full(40, -1.2), heights], axis=1), 0.03)
    gaussians = concat([world.gaussians, post])
    hiding = hides_free_places(gaussians, world.views, Z_UP, RasterOptions(threads=2))
    assert not hiding[-40:].any()


def test_results_do_not_depend_on_threads_or_on_exposure(world: World, tmp_path: Path) -> None:
    alone = compared(world.views, world.gaussians, threads=1)
    assert (alone.shares == world.clean.shares).all()
    darker = []
    for view in world.views:
        with Image.open(view.image) as image:
            Image.fromarray(to_bytes(np.asarray(image) / 255 * 0.7)).save(tmp_path / view.name)
        darker.append(replace(view, image=str(tmp_path / view.name)))
    assert compared(darker, world.gaussians).shares[:, 0].max() < 0.02


def test_places_are_free() -> None:
    """Cameras in a row face a wall, with another one close to their left that a camera behind them
    sees: one does not move through it."""
    gaussians = concat([wall(), side_wall(-0.7)])
    row = [camera(f"{i}.png", (0.2 * i, 0.0, 0.0), focal=30.0) for i in range(4)]
    views = [*row, camera("back.png", (1.0, 0.0, -3.0), focal=30.0)]
    training = render_training_views(views, renderer(gaussians))
    assert training is not None
    chosen = [novel for novel in choose_novel_views(training, UP) if novel.base in row]
    places = {kind: [novel for novel in chosen if novel.kind == kind] for kind in KINDS}
    assert [len(places[kind]) for kind in KINDS] == [3, 4, 4, 4]
    for novel in places["beside"]:
        offset = novel.view.centre - novel.base.centre
        np.testing.assert_allclose(offset, [0.3 * novel.distance, 0, 0], atol=1e-9)
    for novel in places["between"]:
        x = novel.view.centre[0] / 0.2
        assert x == pytest.approx(np.floor(x) + 0.5)
    for novel in places["raised"]:
        subject = novel.base.centre + np.array([0, 0, novel.distance])
        offset = novel.view.world_to_camera[:3, :3] @ (subject - novel.view.centre)
        np.testing.assert_allclose(offset[:2], 0, atol=1e-9)
    for novel in places["behind"]:
        assert novel.view.centre[2] == pytest.approx(-0.35 * novel.distance)


def side_wall(x: float) -> Gaussians:
    """A wall in the plane ``x``, from behind the cameras to the wall in front of them."""
    y, z = np.meshgrid(np.arange(-2, 2, 0.1), np.arange(-1, 4, 0.1))
    return balls(np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1), 0.06)
