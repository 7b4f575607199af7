"""Maps of a synthetic yard show heights and colours where they are; rasterio reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Geod

from pipeline.config.export import Export
from pipeline.survey.map_frame import map_frame
from pipeline.survey.outputs import write_survey
from tests.survey.yard import (
    BOX,
    BOX_HEIGHT,
    CARTESIAN,
    FEET,
    US_FOOT,
    colours,
    georeference,
    height,
    make_yard,
)

rasterio = pytest.importorskip("rasterio", reason="the extra test is not installed")

GPS = georeference()
GCP = georeference(CARTESIAN, FEET, (US_FOOT, US_FOOT))


@pytest.fixture(params=[GPS, GCP], ids=["UTM", "feet"])
def yard(tmp_path: Path, request):
    return make_yard(tmp_path, request.param)


def cells(raster, frame):
    """x and y of the centres of a raster's cells in the scene's frame, for points of height 0."""
    rows, columns = np.mgrid[: raster.height, : raster.width]
    east, north = rasterio.transform.xy(raster.transform, rows.ravel(), columns.ravel())
    flat = np.full(rows.size, frame.origin[2] / frame.height_unit)
    xyz = frame.to_scene(np.column_stack([east, north, flat]))
    return xyz[:, 0].reshape(rows.shape), xyz[:, 1].reshape(rows.shape)


def test_heights_and_colours_are_where_they_are(yard, tmp_path):
    frame = map_frame(yard.georeference)
    report = write_survey(tmp_path, yard, Export(formats=("ortho",)), 2)
    assert any("0.2 m" in line for line in report.decisions)  # 30 m / 150 px.
    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert CRS.from_wkt(file.crs.to_wkt()).equals(frame.crs, ignore_axis_order=True)
        x, y = cells(file, frame)
        found = file.read(1, masked=True) * frame.height_unit - frame.origin[2]
        # Ground that a wall hides is interpolated, in up to two cells.
        near_edge = np.zeros(x.shape, bool)
        for dx, dy in ((0.4, 0), (-0.4, 0), (0, 0.4), (0, -0.4)):
            near_edge |= height(x + dx, y + dy) != height(x, y)
        wrong = (np.abs(found - height(x, y)) > 0.02) & ~near_edge
        assert not wrong.filled(False).any()
        middle = (abs(x) < 8) & (abs(y) < 6)
        assert not found.mask[middle].any()
        # Where the roof ends, to half a cell: its area.
        roof = (found > BOX_HEIGHT / 2).filled(False).sum() * 0.2**2
        side = BOX[2] - BOX[0]
        assert (side - 0.2) ** 2 < roof < (side + 0.2) ** 2
    with rasterio.open(tmp_path / "orthophoto.tif") as file:
        assert file.count == 4 and file.colorinterp[3].name == "alpha"
        x, y = cells(file, frame)
        rgb, alpha = np.moveaxis(file.read()[:3], 0, -1), file.read(4)
        shown = (alpha == 255) & (abs(x) < 8) & (abs(y) < 6) & ~near_edge
        assert shown.sum() > 4500
        # 8 levels a metre: half a cell of 0.2 m is 0.8 levels.
        error = rgb[..., :2][shown].astype(float) - colours(x, y)[..., :2][shown]
        assert np.abs(np.median(error, axis=0)).max() < 0.5
        assert np.quantile(np.abs(error), 0.99) < 2.0


def test_the_same_files_at_any_number_of_threads(yard, tmp_path):
    for threads in (1, 3):
        (tmp_path / str(threads)).mkdir()
        write_survey(tmp_path / str(threads), yard, Export(formats=("ortho", "laz")), threads)
    names = {path.name for path in (tmp_path / "1").iterdir()}
    assert names == {"orthophoto.tif", "dsm.tif", "dense_points.laz", "accuracy.html"}
    for name in names:
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "3" / name).read_bytes()


def test_a_coarser_cell_is_configured(yard, tmp_path):
    config = Export(formats=("ortho",), ground_sampling_m=1.0)
    write_survey(tmp_path, yard, config, 1)
    with rasterio.open(tmp_path / "orthophoto.tif") as file:
        assert file.res[0] * map_frame(yard.georeference).unit == pytest.approx(1.0)


def test_lengths_and_north_on_the_map_are_those_of_the_ellipsoid():
    frame = map_frame(GPS)
    ends = frame.to_map(np.array([[0.0, 0, 0], [0, 1000, 0]]))
    from pyproj import Transformer

    to_degrees = Transformer.from_crs(frame.crs, "EPSG:4326", always_xy=True)
    longitude, latitude = to_degrees.transform(ends[:, 0], ends[:, 1])
    azimuth, _, length = Geod(ellps="WGS84").inv(
        longitude[0], latitude[0], longitude[1], latitude[1]
    )
    # The tangent plane is at 250 m, where lengths are longer by that share of the radius.
    assert azimuth == pytest.approx(0, abs=1e-6)
    assert length * (1 + 250 / 6.36e6) == pytest.approx(1000, abs=0.01)
    grid = np.degrees(np.arctan2(*(ends[1] - ends[0])[:2]))
    assert 0.5 < abs(grid) < 1.5  # The convergence of meridians: 1.3 degrees from the middle.


@pytest.mark.parametrize("frame", [GPS, GCP], ids=["UTM", "feet"])
def test_the_map_and_the_scene_are_inverse(frame):
    points = np.random.default_rng(0).normal(size=(100, 3)) * [3000, 3000, 200]
    found = map_frame(frame)
    np.testing.assert_allclose(found.to_scene(found.to_map(points)), points, atol=1e-5)
