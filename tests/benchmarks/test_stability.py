"""The cases compare like with like: another world shows every camera the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.record_tables import outcomes
from benchmarks.results import StabilityResult
from benchmarks.stability.cases import CASES, TURN, exposed, similar
from pipeline.geometry.cameras import Camera
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction


def test_every_reference_is_a_case_before_its_own() -> None:
    order = list(CASES)
    for name, case in CASES.items():
        if case.expected == "same":
            assert order.index(case.reference) <= order.index(name), name


def test_another_world_shows_the_same() -> None:
    rng = np.random.default_rng(0)
    camera = Camera("PINHOLE", 20, 10, np.array([15.0, 15, 10, 5]))
    pose = PosedImage("a.png", 1, TURN, np.array([0.1, -0.2, 4.0]))
    empty = Points.empty()
    xyz = rng.normal(size=(5, 3))
    points = Points(
        xyz,
        np.zeros((5, 3), np.uint8),
        np.zeros(5),
        np.zeros(6, np.int64),
        empty.track_image_id,
        empty.track_xy,
    )
    moved = similar(
        Reconstruction({1: camera}, {1: pose}, points), 1e-3, TURN, np.array([1e3, -2e3, 5.0])
    )
    local = xyz @ pose.rotation.T + pose.translation
    image = moved.images[1]
    again = moved.points.xyz @ image.rotation.T + image.translation
    np.testing.assert_allclose(again, 1e-3 * local, atol=1e-11)


def test_brighter_than_white_is_white() -> None:
    assert exposed(4)(np.array([[[10, 100, 255]]], np.uint8), 0).tolist() == [[[40, 255, 255]]]


def test_the_table_tells_what_is_wrong() -> None:
    good = StabilityResult("posed", "", 0, 20.0, 0.7, None, None, 100, "", False, True)
    off = replace(good, case="scale_1e4", reference="posed", difference_db=-0.5, right=False)
    text = outcomes([good, off])
    assert "-0.500 (posed)" in text and text.count("**WRONG**") == 1
