"""Disagreement on colours: low in one light at any exposure, high in several lights."""

from __future__ import annotations

import numpy as np
from PIL import Image

from pipeline.geometry.cameras import Camera
from pipeline.photos.disagreement import colour_disagreement
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.views import View

SIZE, SIDE, SPACING = 128, 16, 8
LIMIT = 0.13


def photographs(folder, lights, gains, *, tracks="all", shift=0.0):
    """A wall of 16 x 16 coloured tiles in several lights, in each of which tiles have other
    colours.

    Args:
        lights: of each photograph, a number.
        tracks: all: each point is observed in all photographs; light: a track has the photographs
            of one light; none: the model has no points.
        shift: of each camera to the left of the previous one, world units; the wall is at depth 1.
    """
    count = SIDE * SIDE
    at = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), -1).reshape(-1, 2) * SPACING
    centres = at + SPACING / 2
    xyz = np.column_stack([(centres - SIZE / 2) / SIZE, np.ones(count)])
    views, images = [], {}
    for index, (light, gain) in enumerate(zip(lights, gains, strict=True)):
        colours = np.random.default_rng(light).uniform(0.2, 0.6, (SIDE, SIDE, 3)) * gain
        picture = np.kron(colours, np.ones((SPACING, SPACING, 1)))
        path = folder / f"{index}.png"
        Image.fromarray(np.rint(picture.clip(0, 1) * 255).astype(np.uint8)).save(path)
        pose, half = np.eye(4), SIZE / 2
        pose[0, 3] = shift * index
        name = path.name
        views.append(View(name, str(path), None, SIZE, SIZE, SIZE, SIZE, half, half, pose, False))
        images[index + 1] = PosedImage(name, 1, np.eye(3), np.zeros(3))
    groups = [range(len(lights))]
    if tracks == "light":
        groups = [[i for i, other in enumerate(lights) if other == light] for light in set(lights)]
    parts = [(np.arange(count) + count * k, group) for k, group in enumerate(groups)]
    owner = np.concatenate([np.repeat(rows, len(group)) for rows, group in parts])
    number = np.concatenate([np.tile(np.array(group) + 1, count) for _, group in parts])
    total = count * len(groups)
    starts = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=total))])
    repeated = np.tile(xyz, (len(groups), 1))
    points = Points(
        repeated,
        np.zeros((total, 3), np.uint8),
        np.zeros(total),
        starts,
        number,
        centres[owner % count],
    )
    if tracks == "none":
        points = Points.without_tracks(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    camera = Camera("PINHOLE", SIZE, SIZE, np.array([SIZE, SIZE, SIZE / 2, SIZE / 2]))
    return views, Reconstruction({1: camera}, images, points), xyz


def test_exposure_and_white_balance_are_no_disagreement(tmp_path):
    gains = 2.0 ** np.random.default_rng(1).uniform(-0.5, 0.5, (8, 3))
    assert colour_disagreement(*photographs(tmp_path, [0] * 8, gains)).value < 0.03


def test_other_lights_are(tmp_path):
    ones = np.ones((8, 3))
    assert colour_disagreement(*photographs(tmp_path, [0, 1] * 4, ones)).value > 2 * LIMIT
    one = photographs(tmp_path, [0] * 7 + [1], ones)
    assert colour_disagreement(*one).value < LIMIT, "a single photograph in another light"


def test_photographs_from_the_same_place_need_no_common_tracks(tmp_path):
    ones = np.ones((8, 3))
    for tracks in ("light", "none"):
        same = photographs(tmp_path, [0, 1] * 4, ones, tracks=tracks)
        assert colour_disagreement(*same).value > 2 * LIMIT
    apart = photographs(tmp_path, [0, 1] * 4, ones, tracks="none", shift=0.1)
    assert colour_disagreement(*apart).value == 0


def test_masked_points_are_not_compared(tmp_path):
    views, model, points = photographs(tmp_path, [0, 1] * 4, np.ones((8, 3)))
    Image.fromarray(np.zeros((SIZE, SIZE), np.uint8)).save(tmp_path / "mask.png")
    masked = [
        View(v.name, v.image, str(tmp_path / "mask.png"), *[getattr(v, n) for n in (
            "width", "height", "fx", "fy", "cx", "cy", "world_to_camera", "is_test")])
        for v in views
    ]  # fmt: skip
    assert colour_disagreement(masked, model, points).value == 0
