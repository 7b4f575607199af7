"""GeoTIFF files, read by rasterio (GDAL) and tifffile."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS

from pipeline.io import geotiff
from pipeline.io.geotiff import NODATA, TILE, Georeferenced, halved, write_geotiff

rasterio = pytest.importorskip("rasterio", reason="the extra test is not installed")

PLACE = Georeferenced(CRS.from_epsg(32733), 250_000.25, 6_300_000.5, 0.05)
SYSTEMS = (
    "EPSG:32633",
    "EPSG:2225",  # US survey feet
    "EPSG:2193",  # northing before easting
    "EPSG:25832+5783",  # with heights
    "+proj=lcc +lat_1=33 +lat_2=45 +lat_0=39 +lon_0=-96 +datum=NAD83 +units=us-ft",
    "+proj=tpeqd +lon_1=1 +lat_1=50 +lon_2=3 +lat_2=51 +datum=WGS84",
)


def write(path: Path, raster, place=PLACE) -> Path:
    height, width = raster.shape[:2]
    strips = (raster[top : top + TILE] for top in range(0, height, TILE))
    write_geotiff(path, strips, width, height, place)
    return path


def made(width: int, height: int, is_float: bool, seed: int = 0):
    rng = np.random.default_rng(seed)
    if not is_float:
        return rng.integers(0, 256, (height, width, 4), dtype=np.uint8)
    heights = rng.normal(size=(height, width)).astype(np.float32)
    heights[rng.random(heights.shape) < 0.3] = NODATA
    return heights


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 700), st.integers(1, 700), st.booleans(), st.booleans())
def test_what_was_written_is_read(tmp_path_factory, width, height, is_float, big):
    raster = made(width, height, is_float, width)
    with pytest.MonkeyPatch.context() as patch:
        if big:
            patch.setattr(geotiff, "_BIG", 0)
        path = write(tmp_path_factory.mktemp("t") / "a.tif", raster)
    with rasterio.open(path) as file:
        found = file.read(1) if is_float else np.moveaxis(file.read(), 0, -1)
        assert file.transform[:6] == (0.05, 0, 250_000.25, 0, -0.05, 6_300_000.5)
        assert file.nodata == (NODATA if is_float else None)
        factors = file.overviews(1)
    np.testing.assert_array_equal(found, raster)
    assert bool(factors) == (max(width, height) > TILE)
    level = raster
    for number in range(len(factors)):
        level = halved(level)
        with rasterio.open(path, overview_level=number) as file:
            found = file.read(1) if is_float else np.moveaxis(file.read(), 0, -1)
        np.testing.assert_array_equal(found, level)
    if not is_float:
        np.testing.assert_array_equal(tifffile.imread(path), raster)


@pytest.mark.parametrize("text", SYSTEMS)
def test_the_coordinate_system_is_read(tmp_path, text):
    crs = CRS.from_user_input(text)
    path = write(tmp_path / "a.tif", made(3, 2, True), Georeferenced(crs, 0.0, 0.0, 1.0))
    with rasterio.open(path) as file:
        assert CRS.from_wkt(file.crs.to_wkt()).equals(crs, ignore_axis_order=True)


def test_directories_come_first_and_the_full_size_last(tmp_path):
    path = write(tmp_path / "a.tif", made(1100, 700, False))
    with tifffile.TiffFile(path) as file:
        pages = list(file.pages)
        assert [page.subfiletype for page in pages] == [0, 1, 1, 1]
        firsts = [page.dataoffsets[0] for page in pages]
        assert firsts == sorted(firsts, reverse=True)
        assert max(page.offset for page in pages) < min(firsts)


def test_means_are_of_known_cells_and_of_light():
    heights = np.array([[2, NODATA], [4, NODATA]], np.float32)
    assert halved(heights).tolist() == [[3.0]]
    rgba = np.array([[[200, 0, 0, 255], [0, 0, 0, 0]]], np.uint8)
    assert halved(rgba).tolist() == [[[200, 0, 0, 64]]]


def test_wrong_numbers_of_rows_are_errors(tmp_path):
    with pytest.raises(ValueError, match="expected 5 rows, found 4"):
        write_geotiff(tmp_path / "a.tif", [made(3, 4, True)], 3, 5, PLACE)
    assert not (tmp_path / "a.tif").exists()


def test_small_files_are_classic_tiff(tmp_path):
    data = write(tmp_path / "a.tif", made(3, 4, True)).read_bytes()
    assert struct.unpack("<2sH", data[:4]) == (b"II", 42)
