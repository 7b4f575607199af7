"""The synthetic town: exact truth, the same bytes, and cost that does not grow with the town."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from benchmarks.town.__main__ import main
from benchmarks.town.finishes import Finish
from benchmarks.town.layout import LENGTH, WIDTH, build
from benchmarks.town.paths import PHOTOGRAPHS_PER_CELL, camera_path, cells_of
from benchmarks.town.pyramids import pyramid
from benchmarks.town.solids import Ellipsoid, Prism, Solid, box
from benchmarks.town.visibility import GROUND, SKY, Grid, Shapes, visible
from benchmarks.town.write import TownSpec, write_town
from pipeline.demo.cameras import lens, look_at
from pipeline.demo.render import rays
from pipeline.demo.shapes import Box, Sphere
from pipeline.io.colmap import read_model
from pipeline.plan.sequence import why_ordered
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Photo
from pipeline.scene.reconstruction import PosedImage
from tests.demo.test_demo import load, to_view, to_world

SPEC = TownSpec(photographs=6, width=96, height=64)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("town") / "scene"
    write_town(folder, replace(SPEC, poses="colmap"))
    return folder


@pytest.fixture(scope="module")
def scattered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("town") / "scattered"
    write_town(folder, replace(SPEC, order="scattered"))
    return folder


def files(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.*")}


def test_depth_reprojects_one_photograph_onto_the_next(folder: Path) -> None:
    camera, views, pictures, depths = load(folder)
    assert len(views) == 6
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(64) + 0.5)
    for first, second in ((0, 1), (3, 2), (4, 5)):
        xyz = to_world(camera, views[first], np.stack([x, y], -1), depths[first].astype(float))
        xy, z = to_view(camera, views[second], xyz)
        at = (xy - 0.5).astype(np.float32)
        depth = cv2.remap(depths[second], at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        same = np.abs(depth - z) < 0.01 * z
        assert same.mean() > 0.3

        def error(dx: float, dy: float, at=at, same=same, first=first, second=second) -> float:
            moved = at + np.array([dx, dy], np.float32)
            colour = cv2.remap(pictures[second], moved[..., 0], moved[..., 1], cv2.INTER_LINEAR)
            return float(np.mean((colour.astype(float) - pictures[first])[same] ** 2))

        # Any other alignment is worse: the truth is not off by a fraction of a pixel.
        assert all(
            error(0, 0) < error(*shift) for shift in ((0.5, 0), (0, 0.5), (-0.5, 0), (0, -0.5))
        )


def test_points_lie_on_what_their_photographs_see(folder: Path) -> None:
    camera = load(folder)[0]
    model = read_model(folder / "sparse" / "0")
    points = model.points
    assert len(points) > 200 and points.track_length.min() >= 2
    owner = np.repeat(np.arange(len(points)), points.track_length)
    for number, image in model.images.items():
        here = points.track_image_id == number
        xy, z = to_view(camera, image, points.xyz[owner[here]])
        np.testing.assert_allclose(xy, points.track_xy[here], atol=1e-6)
        column, row = xy.astype(int).T
        depth = np.load(folder / "depth_gt" / f"{Path(image.name).stem}.npy")[row, column]
        assert np.all(np.abs(depth - z) < 0.02 * z)


def test_same_bytes_at_any_number_of_processes(folder: Path, tmp_path: Path) -> None:
    write_town(tmp_path / "s", replace(SPEC, poses="colmap"), 2)
    assert files(tmp_path / "s") == files(folder)


def test_scattered_photographs_are_the_same_under_other_names(
    folder: Path, scattered: Path
) -> None:
    found = {(p.centre.tobytes(), p.rotation.tobytes()): p.name for p in load(folder)[1]}
    moved = 0
    for view in load(scattered)[1]:
        name = found[view.centre.tobytes(), view.rotation.tobytes()]
        moved += name != view.name
        pictures = (
            np.asarray(Image.open(root / "images" / own))
            for root, own in ((folder, name), (scattered, view.name))
        )
        np.testing.assert_array_equal(*pictures)
    assert moved > 2


@pytest.mark.parametrize("sequence", [True, False])
def test_exif_has_the_lens_and_times_that_give_the_order(
    folder: Path, scattered: Path, sequence: bool
) -> None:
    photos = []
    for path in sorted(((folder if sequence else scattered) / "images").iterdir()):
        exif = Image.open(path).getexif()
        photo = exif.get_ifd(0x8769)
        assert photo[37386] == 28 and exif[272] == "Demo 1"
        taken = str(photo[36867]).replace(":", "-", 2)
        photos.append(
            Photo(name=path.name, path=str(path), width=1, height=1, digest="0", taken=taken)
        )
    assert (why_ordered(photos) is not None) == sequence


def test_given_poses_are_the_true_ones(tmp_path: Path) -> None:
    write_town(
        tmp_path / "s", replace(SPEC, photographs=3, width=32, height=24, poses="transforms")
    )
    given = json.loads((tmp_path / "s" / "transforms.json").read_text())
    truth = read_model(tmp_path / "s" / "sparse_gt").by_name()
    for frame in given["frames"]:
        view = truth[Path(frame["file_path"]).name]
        pose = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(pose[:3, 3], view.centre, atol=1e-9)
        np.testing.assert_allclose(-pose[:3, 2], view.rotation[2], atol=1e-9)


def test_area_grows_with_the_photographs_and_the_first_ones_stay() -> None:
    few, many = (camera_path([f"{i}" for i in range(n)], 0) for n in (80, 700))
    for a, b in zip(few, many, strict=False):
        np.testing.assert_array_equal(a.centre, b.centre)
        np.testing.assert_array_equal(a.rotation, b.rotation)
    for photographs in (125, 300, 1000, 5000):
        cells = cells_of(photographs)
        assert len(set(cells)) == len(cells)
        assert 0 <= len(cells) * PHOTOGRAPHS_PER_CELL - photographs < PHOTOGRAPHS_PER_CELL
        where = np.array([posed.centre for posed in camera_path(["x"] * photographs, 0)])
        area = len(cells) * LENGTH * WIDTH
        assert np.ptp(where[:, 0]) * np.ptp(where[:, 1]) < 2.5 * area  # about square
        # Every photograph is taken over or in a cell of the town, or near its edge.
        low = np.array(cells) * (LENGTH, WIDTH) - (0, WIDTH / 2)
        gap = np.maximum(low[None] - where[:, None, :2], where[:, None, :2] - low - (LENGTH, WIDTH))
        assert gap.max(2).min(1).max() < 20


def test_each_photograph_overlaps_with_the_one_before() -> None:
    camera = lens("none", 32, 22)
    views = camera_path([f"{i}" for i in range(2 * PHOTOGRAPHS_PER_CELL)], 0)
    shapes = Shapes.of(list(build(cells_of(len(views)), 0).solids))
    through = rays(camera)
    grid = Grid(through.centres[0], through.centres[1])
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(22) + 0.5)
    shares = []
    for before, after in pairwise(views):
        inverse = visible(shapes, before, grid).inverse
        where = inverse > 0
        xyz = to_world(camera, before, np.stack([x, y], -1)[where], 1 / inverse[where])
        xy, z = to_view(camera, after, xyz)
        shares.append(np.mean((z > 0) & np.all((xy > 0) & (xy < (32, 22)), axis=-1)))
    jump = PHOTOGRAPHS_PER_CELL - 1  # from the end of a walk to the flight over the next cell
    shares = np.delete(shares, jump)
    assert shares.min() > 0.35 and np.median(shares) > 0.6


def test_no_camera_is_inside_of_a_solid() -> None:
    views = camera_path([f"{i}" for i in range(400)], 0)
    centres = np.array([posed.centre for posed in views])
    for solid in build(cells_of(400), 0).solids:
        if isinstance(solid, Prism):
            gaps = [(centres * f.normal).sum(1) - f.offset for f in solid.faces]
            assert np.max(gaps, axis=0).min() > 0.2
        else:
            reach = np.array(solid.radii) + 0.2
            assert (((centres - solid.centre) / reach) ** 2).sum(1).min() > 1


def test_cost_of_a_ray_does_not_grow_with_the_town() -> None:
    through = rays(lens("none", 96, 64))
    grid = Grid(through.centres[0], through.centres[1])
    costs = []
    for photographs in (PHOTOGRAPHS_PER_CELL, 1000):
        shapes = Shapes.of(list(build(cells_of(photographs), 0).solids))
        views = camera_path([f"{i}" for i in range(PHOTOGRAPHS_PER_CELL)], 0)[::6]
        costs.append(np.mean([visible(shapes, v, grid).tests for v in views]) / grid.x.size)
    assert costs[1] < 1.3 * costs[0] and costs[1] < 3


def plain(_: object) -> Finish:
    return Finish(0, (0.5, 0.5, 0.5))


def test_first_hits_are_those_of_the_shapes_one_by_one() -> None:
    rng = np.random.default_rng(4)
    solids: list[Solid] = []
    shapes: list[Box | Sphere] = []
    for _ in range(25):
        x, y = rng.uniform(-8, 8, 2)
        size = tuple(float(v) for v in rng.uniform(0.3, 3, 3))
        yaw, bottom = float(rng.uniform(-3, 3)), float(rng.uniform(0, 2))
        solids.append(box((x, y), size, bottom, yaw, plain))  # type: ignore[arg-type]
        half = (size[0] / 2, size[1] / 2, size[2] / 2)
        shapes.append(Box((x, y, bottom + half[2]), half, yaw))
        x, y, radius = *rng.uniform(-8, 8, 2), float(rng.uniform(0.2, 1.5))
        solids.append(Ellipsoid((x, y, 2.0), (radius,) * 3, (0.1, 0.1, 0.1), 0))
        shapes.append(Sphere((x, y, 2.0), radius))
    through = rays(lens("opencv", 120, 80)).centres
    grid = Grid(through[0], through[1])
    compared = 0
    for _ in range(40):
        centre = np.array([*rng.uniform(-10, 10, 2), rng.uniform(0.5, 6)])
        rotation = look_at(centre, np.array([*rng.uniform(-3, 3, 2), 1.0]), rng.uniform(-1, 1))
        direction = np.einsum("ji,jrc->irc", rotation, through).reshape(3, -1)
        if min(float(shape.distance(centre[:, None])[0]) for shape in shapes) < 0.1:
            continue
        compared += 1
        hits = visible(Shapes.of(solids), PosedImage("a", 1, rotation, -rotation @ centre), grid)
        t = np.stack([shape.hit(centre[:, None], direction) for shape in shapes])
        down = np.where(direction[2] < 0, centre[2] / np.maximum(-direction[2], 1e-12), np.inf)
        with np.errstate(divide="ignore"):
            depth = 1 / hits.inverse.ravel()
        expected = np.minimum(t.min(0), np.where(down < 700, down, np.inf))
        np.testing.assert_allclose(depth, expected, rtol=1e-9)
        label = hits.label.ravel()
        assert np.all((label == SKY) == np.isinf(expected))
        assert np.all((label == GROUND) == (down < np.minimum(t.min(0), 700)))
        for value in np.unique(label[label > GROUND]):
            solid, face = hits.seen[value - 2]
            if isinstance(solid, Prism):
                point = centre[:, None] + depth[label == value] * direction[:, label == value]
                gap = (solid.faces[face].normal[:, None] * point).sum(0) - solid.faces[face].offset
                np.testing.assert_allclose(gap, 0, atol=1e-8)
    assert compared > 15


def test_textures_are_seen_from_outside_and_upright() -> None:
    for face in box((1, 2), (3, 4, 5), 0.5, 0.3, plain).faces:
        # From outside, right x down points into the solid, as for an image.
        np.testing.assert_allclose(np.cross(face.right, face.down), -face.normal, atol=1e-12)
        assert (face.origin * face.normal).sum() == pytest.approx(face.offset)
        if abs(face.normal[2]) < 0.5:
            assert face.down[2] == pytest.approx(-1) and face.origin[2] == pytest.approx(5.5)


def test_a_pyramids_level_is_the_mean_of_its_texels() -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 255, (64, 32, 3)).astype(np.float32)
    x, y = np.array([4.0, 12.0, 20.0], np.float32), np.array([4.0, 44.0, 60.0], np.float32)
    found = pyramid(image).sample(x, y, np.full(3, 3, np.float32))
    for value, column, row in zip(found, x, y, strict=True):
        part = image[int(row) - 4 : int(row) + 4, int(column) - 4 : int(column) + 4]
        np.testing.assert_allclose(value, part.mean(axis=(0, 1)), atol=1)
    tiles = pyramid(image[:32], periodic=True)
    shifted = tiles.sample(x + 96, y - 64, np.full(3, 1.5, np.float32))
    np.testing.assert_allclose(shifted, tiles.sample(x, y, np.full(3, 1.5, np.float32)), atol=0.01)


def test_wrong_options_and_foreign_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "a"), "--photographs", "0"]) == 2
    assert "0 photographs" in capsys.readouterr().err
    assert main([str(tmp_path / "a"), "--size", "9000x20"]) == 2
    assert "9000x20" in capsys.readouterr().err and not (tmp_path / "a").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "holiday.jpg").write_bytes(b"")
    with pytest.raises(UserError, match="no synthetic town"):
        write_town(tmp_path / "mine", SPEC)
    small = [str(tmp_path / "b"), "--photographs", "1", "--size", "32x24"]
    small += ["--processes", "1"]
    assert main(small) == 0 and main(small) == 0  # a town may be written over
    assert json.loads((tmp_path / "b" / "town.json").read_text())["photographs"] == 1
    assert len(list((tmp_path / "b" / "depth_gt").iterdir())) == 1
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "--photographs" in capsys.readouterr().out
