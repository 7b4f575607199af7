"""The measure of a mesh's accuracy, and fusion of exact depth maps of the demo scene."""

from __future__ import annotations

import numpy as np
import pytest

import benchmarks.mesh_accuracy as surface
from benchmarks.mesh_accuracy import FOCUS, Similarity, measure, sample, true_points
from pipeline.demo.scene import OBJECTS, ROOM, distance, trace
from pipeline.surface.mesh import build_mesh
from tests.surface.scenes import demo_room


@pytest.fixture
def few_samples(monkeypatch):
    """Few enough to be fast."""
    monkeypatch.setattr(surface, "SAMPLES", 60_000)


def middle(mesh):
    """The faces near the focus of the cameras."""
    near = np.linalg.norm(mesh.vertices[mesh.faces[:, 0]] - FOCUS, axis=1) < 1.3
    return mesh.faces[near]


def test_signed_distances_agree_with_ray_hits():
    """Zero at hits, and equal to the offset along the normal."""
    rng = np.random.default_rng(0)
    origin = np.array([[1.9], [-1.4], [1.3]])
    direction = np.array([[0.0], [0.0], [0.45]]) - origin + 0.4 * rng.normal(size=(3, 4000))
    t, index = trace(origin, direction, OBJECTS)
    hit = origin + t * direction
    assert len(np.unique(index)) > 5
    assert np.abs(distance(hit)).max() < 1e-9
    for i in np.unique(index):
        shape = ROOM if i < 0 else OBJECTS[i].shape
        at = hit[:, index == i]
        normal = shape.normal(at)
        off = shape.distance(at + 0.05 * normal)
        # In the room's corners another wall may be nearer.
        assert (off < 0.05 + 1e-9).all()
        assert np.isclose(off, 0.05, atol=1e-9).mean() > (0.9 if i < 0 else 0.999)
        assert (shape.distance(at - 0.01 * normal) < 0).all()


def test_exact_depths_reconstruct_the_demo_scene(few_samples):
    """In an arbitrary frame and scale, as from structure from motion."""
    maps, views = demo_room(views=12, width=120, height=90)
    frame = Similarity(1.0, np.eye(3), np.zeros(3))
    mesh, _ = build_mesh(maps, 0.04, threads=2)
    truth, faces = true_points(views, frame), middle(mesh)
    found = measure(mesh.vertices, faces, truth, frame)
    assert found["foreground"].median < 0.0025
    assert found["foreground"].completeness > 0.85
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = Similarity(0.5, turn, np.array([1.0, 2.0, 3.0]))
    again = measure(moved.undo(mesh.vertices), faces, truth, moved)
    assert np.isclose(again["foreground"].median, found["foreground"].median, rtol=1e-3)


def test_the_measure_detects_a_shift_and_a_hole(few_samples):
    maps, views = demo_room(views=6, width=80, height=60)
    frame = Similarity(1.0, np.eye(3), np.zeros(3))
    truth = true_points(views, frame)
    mesh, _ = build_mesh(maps, 0.06, threads=2)
    faces = middle(mesh)
    good = measure(mesh.vertices, faces, truth, frame)["foreground"]
    shifted = measure(mesh.vertices + np.float32(0.1), faces, truth, frame)["foreground"]
    assert shifted.median > good.median + 0.01
    keep = np.linalg.norm(mesh.vertices[faces[:, 0]] - FOCUS, axis=1) > 0.8
    holed = measure(mesh.vertices, faces[keep], truth, frame)["foreground"]
    assert holed.completeness < good.completeness - 0.2


def test_samples_lie_evenly_on_triangles():
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    points = sample(vertices, np.array([[0, 1, 2], [3, 4, 5]]), 20_000)
    low = points[:, 2] == 0
    assert abs(low.mean() - 0.9) < 0.01
    assert np.allclose(points[low].mean(axis=0), [1, 1, 0], atol=0.03)
