"""3D Tiles hold the scene at its place on the earth, at levels of detail within their boxes."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from pipeline.geometry.geodesy import to_ecef
from pipeline.io import tiles3d
from pipeline.io.placement import to_earth
from pipeline.io.spz import decode_spz
from pipeline.io.tiles3d import write_tiles3d
from pipeline.scene.georeference import CartesianOrigin, GeographicOrigin, Georeference
from pipeline.splats.arrays import GaussianRows
from tests.splats.samples import sample

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def georeference(**fields):
    return Georeference(
        residuals_m=None,
        axes="",
        unit="m",
        scale=1.0,
        rotation=IDENTITY,
        translation=(0.0, 0.0, 0.0),
        residuals=(),
        **({"projection": None} | fields),
    )


def moved(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def test_a_frame_by_gps_stands_upright_at_its_origin():
    origin = GeographicOrigin(latitude=48.0, longitude=11.0, altitude=500.0)
    matrix = to_earth(georeference(method="gps", origin=origin))
    at = moved(matrix, np.array([[0, 0, 0], [0, 0, 100.0]]))
    assert np.allclose(at, to_ecef(np.array([[48, 11, 500], [48, 11, 600.0]])), atol=1e-6)
    north = moved(matrix, np.array([[0, 30.0, 0]]))
    assert np.allclose(north, to_ecef(np.array([[48 + 30 / 111_200, 11, 500.0]])), atol=0.05)


@pytest.mark.parametrize("unit", [1.0, 1200 / 3937])
def test_a_frame_in_a_projection_lies_where_the_projection_says(unit):
    """A kilometre from the origin, the linearised projection is right to a decimetre."""
    from pyproj import Transformer

    name = "EPSG:32632" if unit == 1 else "EPSG:2263"
    origin = (544_000.0, 5_320_000.0, 500.0) if unit == 1 else (300_000.0, 60_000.0, 20.0)
    place = CartesianOrigin(x=origin[0], y=origin[1], z=origin[2])
    matrix = to_earth(
        georeference(method="gcp", origin=place, projection=name, projection_units_m=(unit, unit))
    )
    local = np.array([[0.0, 0, 0], [1000, 0, 0], [0, 1000, 30], [-700, -700, -10]])
    metres = local + origin
    longitude, latitude = Transformer.from_crs(name, "EPSG:4326", always_xy=True).transform(
        metres[:, 0] / unit, metres[:, 1] / unit
    )
    expected = to_ecef(np.column_stack([latitude, longitude, metres[:, 2]]))
    assert np.linalg.norm(moved(matrix, local) - expected, axis=1).max() < 0.1


@pytest.mark.parametrize("method", ["level", "given"])
def test_other_frames_have_no_place(method):
    origin = CartesianOrigin(x=1.0, y=2.0, z=3.0) if method == "given" else None
    assert to_earth(georeference(method=method, origin=origin)) is None


@pytest.fixture
def tiles(tmp_path, monkeypatch):
    """A scene of 1,000 Gaussians in tiles of up to 150, placed by a known matrix."""
    monkeypatch.setattr(tiles3d, "LEAF", 150)
    gaussians = sample(1000, 1).as_arrays()
    matrix = to_earth(
        georeference(
            method="gps", origin=GeographicOrigin(latitude=30.0, longitude=-98.0, altitude=3.0)
        )
    )
    rows = GaussianRows(gaussians, np.arange(1000), 1)
    write_tiles3d(tmp_path / "t", rows, matrix)
    write_tiles3d(tmp_path / "u", rows, matrix)
    return tmp_path, gaussians, matrix


def content(file):
    """The document and the Gaussians, in SPZ's axes, of a tile."""
    data = file.read_bytes()
    size, _ = struct.unpack_from("<I4s", data, 12)
    document = json.loads(data[20 : 20 + size])
    start = 28 + size
    length = document["bufferViews"][0]["byteLength"]
    assert len(data) == struct.unpack_from("<I", data, 8)[0]
    return document, decode_spz(data[start : start + length])


def walk(entry):
    yield entry
    for child in entry.get("children", ()):
        yield from walk(child)


def test_the_leaves_hold_the_scene_at_its_place(tiles):
    folder, gaussians, matrix = tiles
    tileset = json.loads((folder / "t" / "tileset.json").read_text())
    transform = np.array(tileset["root"]["transform"]).reshape(4, 4).T
    found = []
    for entry in walk(tileset["root"]):
        document, made = content(folder / "t" / entry["content"]["uri"])
        means = made.means.numpy().astype(float)
        # The file's axes, turned as viewers turn glTF: y up to z up.
        tile = np.column_stack([means[:, 0], means[:, 2], -means[:, 1]])
        centre, half = np.split(np.array(entry["boundingVolume"]["box"]), [3])
        reach = np.abs(half.reshape(3, 3)).sum(0)
        assert (np.abs(tile - centre) <= reach).all(), "the box does not contain the tile"
        assert document["accessors"][0]["count"] == len(means) <= 150
        if "children" not in entry:
            assert entry["geometricError"] == 0
            found.append(moved(transform, tile))
    found = np.concatenate(found)
    expected = moved(matrix, gaussians.means.astype(float))
    assert len(found) == len(expected)
    order, other = (np.lexsort(np.round(points, 2).T) for points in (found, expected))
    assert np.abs(found[order] - expected[other]).max() < 0.02


def test_errors_grow_and_boxes_nest_towards_the_root(tiles):
    folder, *_ = tiles
    tileset = json.loads((folder / "t" / "tileset.json").read_text())
    assert tileset["geometricError"] > 0 and tileset["root"]["refine"] == "REPLACE"
    for entry in walk(tileset["root"]):
        centre, half = np.split(np.array(entry["boundingVolume"]["box"]), [3])
        reach = np.abs(half.reshape(3, 3)).sum(0)
        for child in entry.get("children", ()):
            assert child["geometricError"] < entry["geometricError"]
            at, inner = np.split(np.array(child["boundingVolume"]["box"]), [3])
            inside = np.abs(at - centre) + np.abs(inner.reshape(3, 3)).sum(0)
            assert (inside <= reach + 1e-6).all()


def test_the_same_scene_gives_the_same_bytes(tiles):
    folder, *_ = tiles
    one, two = (sorted((folder / name).iterdir()) for name in "tu")
    assert [p.read_bytes() for p in one] == [p.read_bytes() for p in two] and len(one) > 8
