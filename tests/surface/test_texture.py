"""Textures from photographs: the right colours, none of what is in front, the same bits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from pipeline.runtime.isolate import Limits, run_limited
from pipeline.scene.exposure import ExposureGains, ViewLight
from pipeline.surface.atlas import PART, cut_and_pack, split
from pipeline.surface.mesh import Mesh, vertex_normals
from pipeline.surface.texture import Photographs, bilinear, texture_mesh
from pipeline.surface.triangles import barycentric, draw_triangles
from tests.surface.scenes import rays, view_at

#: The colour of each side of the unit box: -x, +x, -y, +y, -z, +z.
SIDES = np.array(
    [[200, 30, 30], [30, 200, 30], [30, 30, 200], [200, 200, 30], [30, 200, 200], [200, 30, 200]]
)
SCREEN = np.array([90, 90, 90])


def grid_mesh(corner, along, across, count=8):
    """A parallelogram of triangles that face along x across."""
    row, column = (a.ravel() for a in np.indices((count + 1, count + 1)))
    vertices = corner + np.outer(column, along) / count + np.outer(row, across) / count
    at = (row * (count + 1) + column).reshape(count + 1, count + 1)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([c, d, a], 1)])


def joined(parts) -> Mesh:
    """One mesh of unconnected parts."""
    vertices, faces, count = [], [], 0
    for points, triangles in parts:
        vertices.append(points)
        faces.append(triangles + count)
        count += len(points)
    points, triangles = np.concatenate(vertices), np.concatenate(faces)
    return Mesh(
        points.astype(np.float32),
        triangles.astype(np.int32),
        vertex_normals(points, triangles).astype(np.float32),
        np.zeros((len(points), 3), np.uint8),
    )


def box() -> Mesh:
    """The unit box around the origin, its sides in the order of ``SIDES``."""
    parts = []
    for axis in range(3):
        for sign in (-1, 1):
            normal, along = np.zeros(3), np.zeros(3)
            normal[axis], along[(axis + 1) % 3] = sign, 1
            across = np.cross(normal, along)
            parts.append(grid_mesh((normal - along - across) / 2, along, across))
    return joined(parts)


def photograph(view, path, screen_x=None):
    """A photograph of the box, behind a screen at x = ``screen_x`` for y > 0."""
    direction = rays(view)
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (-0.5 * np.sign(direction) - view.centre) / direction
    inside = near.max(axis=1)
    axis = near.argmax(axis=1)
    at = view.centre + inside[:, None] * direction
    hit = (np.abs(at) <= 0.5 + 1e-9).all(axis=1)
    side = 2 * axis + (np.take_along_axis(at, axis[:, None], 1)[:, 0] > 0)
    rgb = np.where(hit[:, None], stripes(at, SIDES[side]), 255)
    if screen_x is not None:
        t = (screen_x - view.centre[0]) / direction[:, 0]
        on = view.centre + t[:, None] * direction
        covers = (t > 0) & (on[:, 1] > 0) & (np.abs(on[:, 1:]) < 0.5).all(axis=1)
        rgb[covers & (~hit | (t < inside))] = SCREEN
    picture = rgb.reshape(view.height, view.width, 3).astype(np.uint8)
    Image.fromarray(picture).save(path)
    return replace(view, image=str(path))


def stripes(at, colours):
    """Darker where x + y + z is in an odd quarter: texture within a side."""
    odd = np.floor(4 * at.sum(axis=1)) % 2 == 1
    return np.where(odd[:, None], colours // 2, colours)


def ring(tmp_path, screen_x=None, count=10):
    """Views from all sides."""
    views = []
    for i in range(count):
        z = 1 - (2 * i + 1) / count
        angle = i * np.pi * (3 - np.sqrt(5))
        flat = np.sqrt(1 - z * z)
        centre = 2.5 * np.array([flat * np.cos(angle), flat * np.sin(angle), z])
        view = view_at(centre, (0, 0, 0), 128, 140.0, name=f"{i}.png")
        views.append(photograph(view, tmp_path / f"{i}.png", screen_x))
    return views


def texels(textured):
    """The texture's colours in charts with their points, and the triangle of each."""
    height, width = textured.picture.shape[:2]
    uv = textured.uv.astype(float) * (width, height)
    drawn = draw_triangles(uv, np.ones(len(uv)), textured.faces, width, height)
    row, column = np.nonzero(drawn.face >= 0)
    face = drawn.face[row, column]
    corners = uv[textured.faces[face]]
    weights = barycentric(corners, np.column_stack([column, row]) + 0.5)
    points = (weights[..., None] * textured.vertices[textured.faces[face]]).sum(axis=1)
    return points, face, textured.picture[row, column].astype(int)


def side_of(textured, face):
    normal = textured.normals[textured.faces[face]].sum(axis=1)
    axis = np.abs(normal).argmax(axis=1)
    return 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] > 0)


def test_texels_have_the_colours_of_the_box(tmp_path):
    textured = texture_mesh(box(), Photographs(ring(tmp_path)), 0.02, None, threads=2)
    points, face, found = texels(textured)
    expected = stripes(points, SIDES[side_of(textured, face)])
    # Not at the borders of stripes, where pixels mix them.
    phase = (4 * points.sum(axis=1)) % 1
    inner = (np.abs(phase - 0.5) < 0.25) & (np.sort(np.abs(points), axis=1)[:, 1] < 0.45)
    assert inner.sum() > 5000
    error = np.abs(found - expected)[inner].max(axis=1)
    assert np.percentile(error, 95) < 12 and np.median(error) <= 2
    # About as many texels as the photographs have pixels of each side, where they have most.
    assert 0.7 < len(points) / (6 * (140 / 2) ** 2) < 1.8


def test_the_size_is_bounded(tmp_path):
    textured = texture_mesh(box(), Photographs(ring(tmp_path)), 0.02, 64, threads=1)
    assert max(textured.picture.shape[:2]) <= 64
    assert textured.uv.min() >= 0 and textured.uv.max() <= 1


def test_what_is_in_front_does_not_bleed(tmp_path):
    """A grey screen in front of the side +x, which has its colour from views past the screen."""
    screen = grid_mesh(np.array([0.9, 0.0, -0.5]), np.array([0, 0.5, 0]), np.array([0, 0, 1.0]))
    parts = [screen, (box().vertices.astype(float), box().faces.astype(int))]
    views = ring(tmp_path, screen_x=0.9, count=16)
    textured = texture_mesh(joined(parts), Photographs(views), 0.02, None, threads=2)
    points, face, found = texels(textured)
    behind = (side_of(textured, face) == 1) & (points[:, 0] < 0.6) & (np.abs(points[:, 2]) < 0.45)
    assert behind.sum() > 1000
    green = found[behind, 1] - found[behind][:, [0, 2]].max(axis=1)
    assert (green > 40).mean() > 0.98, "grey texels have the screen's colour"
    front = (points[:, 0] > 0.8) & (np.abs(points[:, 2]) < 0.45) & (points[:, 1] > 0.05)
    assert np.abs(found[front] - SCREEN).max(axis=1).mean() < 15


def test_exposures_are_levelled_and_passers_by_left_out(tmp_path):
    views = ring(tmp_path)
    gains = {view.name: ViewLight(gain=(1.0, 1.0, 1.0)) for view in views}
    for number, view in enumerate(views):
        picture = np.asarray(Image.open(view.image)).astype(float)
        if number % 2:
            gains[view.name] = ViewLight(gain=(0.5, 0.6, 0.5))
            picture = picture * (0.5, 0.6, 0.5)
        Image.fromarray(np.rint(picture).astype(np.uint8)).save(view.image)
    photographs = Photographs(views, ExposureGains(gains))
    textured = texture_mesh(box(), photographs, 0.02, None, threads=2)
    points, face, found = texels(textured)
    expected = stripes(points, SIDES[side_of(textured, face)])
    phase = (4 * points.sum(axis=1)) % 1
    inner = (np.abs(phase - 0.5) < 0.25) & (np.sort(np.abs(points), axis=1)[:, 1] < 0.45)
    assert np.percentile(np.abs(found - expected)[inner].max(axis=1), 95) < 14


def test_masked_pixels_and_test_views_are_not_used(tmp_path):
    views = ring(tmp_path)
    Image.fromarray(np.zeros((128, 128), np.uint8)).save(tmp_path / "mask.png")
    wrong = replace(views[0], name="wrong", image=str(tmp_path / "wrong.png"))
    Image.fromarray(np.full((128, 128, 3), 255, np.uint8)).save(wrong.image)
    more = [replace(wrong, mask=str(tmp_path / "mask.png")), replace(wrong, is_test=True)]
    first = texture_mesh(box(), Photographs(views), 0.02, 200, threads=1)
    again = texture_mesh(box(), Photographs([*views, *more]), 0.02, 200, threads=1)
    assert np.array_equal(first.picture, again.picture)


def test_threads_do_not_change_a_bit(tmp_path):
    photographs = Photographs(ring(tmp_path))
    first, again = (texture_mesh(box(), photographs, 0.02, None, threads=n) for n in (1, 3))
    for name in ("vertices", "faces", "normals", "uv", "picture"):
        assert np.array_equal(getattr(first, name), getattr(again, name)), name


def test_a_mesh_that_no_view_sees_is_grey():
    textured = texture_mesh(box(), Photographs([]), 0.02, 128, threads=1)
    assert (textured.picture == 128).all()


def test_charts_do_not_overlap_and_keep_the_triangles():
    mesh = box()
    faces = mesh.faces.astype(np.int64)
    atlas = cut_and_pack(mesh.vertices.astype(float), faces, np.full(len(faces), 50.0), 1000)
    assert np.array_equal(np.sort(atlas.origin), np.arange(len(faces)))
    assert np.array_equal(
        np.sort(atlas.source[atlas.faces], axis=1), np.sort(faces[atlas.origin], axis=1)
    )
    assert atlas.uv.min() >= 0 and (atlas.uv.max(axis=0) <= atlas.size).all()
    corners = atlas.uv[atlas.faces]
    edges = corners[:, 1:] - corners[:, :1]
    area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum() / 2
    drawn = draw_triangles(atlas.uv, np.ones(len(atlas.uv)), atlas.faces, *atlas.size)
    assert (drawn.face >= 0).sum() == pytest.approx(area, rel=0.02)
    assert area == pytest.approx(6 * 50**2, rel=0.25)


def test_a_chart_larger_than_the_texture_is_made_smaller():
    """Packing it as it is took memory without end."""
    mesh = box()
    faces = mesh.faces.astype(np.int64)
    density = np.full(len(faces), 50.0)
    density[:8] = 1e13
    limits = Limits(seconds=120, memory=2 << 30)
    atlas = run_limited(limits, cut_and_pack, mesh.vertices.astype(float), faces, density, 500)
    assert max(atlas.size) <= 500
    # Its texels are used well: charts of triangles that are drawn somewhere.
    drawn = draw_triangles(atlas.uv, np.ones(len(atlas.uv)), atlas.faces, *atlas.size)
    assert (drawn.face >= 0).mean() > 0.2


def test_a_triangle_under_the_camera_gets_few_texels(tmp_path):
    """The view sees one of its corners; its centre is behind the camera."""
    (view,) = ring(tmp_path, count=1)
    corners = np.array([[-1.0, 0.6, -2.2], [0.8, 0.6, 2.0], [1.0, 0.6, -2.2]])
    corners = corners @ view.world_to_camera[:3, :3] + view.centre
    faces = np.array([[0, 1, 2], [0, 2, 1]])
    parts = [(corners, faces), (box().vertices.astype(float), box().faces.astype(int))]
    textured = texture_mesh(joined(parts), Photographs([view]), 0.02, 300, threads=1)
    _, face, _ = texels(textured)
    under = np.abs(textured.vertices[textured.faces[face]]).max(axis=(1, 2)) > 0.6
    assert 0 < under.sum() < 0.7 * len(face)


def test_parts_are_of_neighbours():
    points = np.random.default_rng(0).random((5 * PART, 3))
    parts = split(points, PART)
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(len(points)))
    assert max(map(len, parts)) <= PART
    assert all(np.ptp(points[part], axis=0).min() < 0.6 for part in parts)


def test_bilinear_interpolation_is_exact_for_ramps():
    picture = np.dstack([np.tile(np.arange(6.0), (4, 1))] * 3)
    found = bilinear(picture, np.array([0.5, 3.0, 6.0, -5.0]), np.array([2.0, 0.5, 4.0, 9.0]))
    assert np.allclose(found[:, 0], [0, 2.5, 5, 0])
