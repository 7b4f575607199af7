"""Exposure: known gains are recovered from synthetic photographs of a wall."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from pipeline.geometry.cameras import Camera
from pipeline.photos.exposure import Exposures, observe, sample_views, solve_gains
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.views import View

SIZE, POINTS = 64, 400


def measure_exposures(views, model) -> Exposures:
    seen = observe(views, model)
    return solve_gains(seen.point, seen.photo, seen.y, seen.num_photos)


def wall(folder, gains, seed=0):
    """Views of a wall of coloured dots, each with its own gains; every second view observes only
    half of the dots."""
    rng = np.random.default_rng(seed)
    colours = rng.uniform(0.25, 0.6, (POINTS, 3))
    at = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2) * 3 + 2
    views, images, owner, number, xy = [], {}, [], [], []
    for index, gain in enumerate(gains):
        picture = np.zeros((SIZE, SIZE, 3))
        picture[at[:, 1], at[:, 0]] = colours * gain
        # Outliers: a tenth of the dots have other colours.
        wrong = rng.permutation(POINTS)[: POINTS // 10]
        picture[at[wrong, 1], at[wrong, 0]] = rng.uniform(0.1, 0.9, (len(wrong), 3))
        path = folder / f"{index}.png"
        Image.fromarray(np.rint(picture.clip(0, 1) * 255).astype(np.uint8)).save(path)
        name, half = f"{index}.png", SIZE / 2
        pose = np.eye(4)
        views.append(View(name, str(path), None, SIZE, SIZE, SIZE, SIZE, half, half, pose, False))
        images[index + 1] = PosedImage(name, 1, np.eye(3), np.zeros(3))
        seen = np.arange(POINTS) if index % 2 else np.arange(POINTS // 2)
        owner.append(seen)
        number.append(np.full(len(seen), index + 1))
        xy.append((at[seen] + 0.5) * 2.0)  # the model's camera is twice the size
    owner, number, xy = (np.concatenate(part) for part in (owner, number, xy))
    order = np.argsort(owner, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=POINTS))])
    points = Points(
        np.zeros((POINTS, 3)),
        np.zeros((POINTS, 3), np.uint8),
        np.zeros(POINTS),
        starts,
        number[order],
        xy[order],
    )
    camera = Camera("PINHOLE", 2 * SIZE, 2 * SIZE, np.array([128.0, 128, 64, 64]))
    return views, Reconstruction({1: camera}, images, points)


def test_gains_are_recovered(tmp_path):
    rng = np.random.default_rng(1)
    true = 2.0 ** rng.uniform(-0.5, 0.5, (9, 3))
    true /= np.exp(np.log(true).mean(axis=0))
    found = measure_exposures(*wall(tmp_path, true))
    np.testing.assert_allclose(found.gains, true, rtol=0.02)
    assert found.measured == 9
    assert found.spread == pytest.approx(2.2 * np.log2(true).std(axis=0).max(), rel=0.05)


def test_equal_exposures_have_no_spread(tmp_path):
    found = measure_exposures(*wall(tmp_path, np.ones((6, 3))))
    assert found.spread < 0.02


def test_views_without_points_have_unit_gains(tmp_path):
    views, model = wall(tmp_path, np.array([[1.0] * 3, [0.5] * 3, [1.5] * 3]))
    only = Reconstruction(model.cameras, model.images)
    found = measure_exposures(views, only)
    assert found.measured == 0 and found.spread == 0
    assert (found.gains == 1).all()


def test_the_sample_is_evenly_spaced(tmp_path):
    views, _ = wall(tmp_path, np.ones((3, 3)))
    assert [v.name for v in sample_views(views)] == ["0.png", "1.png", "2.png"]
    many = sample_views(views * 100)
    assert len(many) == 64 and many[0].name == "0.png" and many[-1].name == "2.png"
