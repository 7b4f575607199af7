"""LAZ files, read by LASzip (the reference implementation) and by hand."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from pyproj import CRS

from pipeline.io.laz import write_laz

RNG = np.random.default_rng(0)
XYZ = RNG.uniform(0, 300, (2000, 3)) + np.array([587_000, 3_338_000, 340])
RGB = RNG.integers(0, 256, (2000, 3), dtype=np.uint8)
UP = np.tile(np.array([0, 0.6, 0.8], np.float32), (2000, 1))


@pytest.fixture
def file(tmp_path):
    write_laz(tmp_path / "a.laz", XYZ, RGB, UP, CRS.from_epsg(32614))
    return tmp_path / "a.laz"


def test_the_header_is_as_las_1_4_says(file):
    data = file.read_bytes()
    signature, encoding = data[:4], struct.unpack("<H", data[6:8])[0]
    assert signature == b"LASF" and encoding & 16  # the system is WKT
    assert data[24:26] == b"\1\4" and data[90:94] == b"\0" * 4
    size, _, records, kind, length = struct.unpack("<HIIBH", data[94:107])
    assert (size, kind & 0x3F, kind & 0x80, length) == (375, 7, 0x80, 36 + 12)
    assert struct.unpack("<3d", data[131:155]) == (0.001,) * 3
    assert all(value == int(value) for value in struct.unpack("<3d", data[155:179]))
    assert struct.unpack("<Q", data[247:255])[0] == len(XYZ)
    found, at = {}, size
    for _ in range(records):
        user, number, count = struct.unpack("<16sHH", data[at + 2 : at + 22])
        found[user.rstrip(b"\0"), number] = data[at + 54 : at + 54 + count]
        at += 54 + count
    wkt = found[b"LASF_Projection", 2112].rstrip(b"\0").decode()
    assert CRS.from_wkt(wkt).to_epsg() == 32614
    extra = found[b"LASF_Spec", 4]
    assert [extra[n * 192 + 4 :][:7] for n in range(3)] == [b"NormalX", b"NormalY", b"NormalZ"]


def test_laszip_reads_points(file):
    laszip = pytest.importorskip("laszip", reason="the extra test is not installed")
    with file.open("rb") as stream:
        unzipper = laszip.LasUnZipper(stream)
        points = np.zeros(len(XYZ) * 48, np.uint8)
        unzipper.decompress_into(points)
    rows = points.reshape(-1, 48)
    offset = np.array(struct.unpack("<3d", file.read_bytes()[155:179]))
    xyz = np.ascontiguousarray(rows[:, :12]).view("<i4") * 0.001 + offset
    np.testing.assert_allclose(xyz, XYZ, atol=0.00051)
    np.testing.assert_array_equal(
        np.ascontiguousarray(rows[:, 30:36]).view("<u2"), RGB.astype(int) * 257
    )
    np.testing.assert_array_equal(np.ascontiguousarray(rows[:, 36:]).view("<f4"), UP)


def test_equal_points_give_equal_bytes(file, tmp_path):
    write_laz(tmp_path / "b.laz", XYZ, RGB, UP, CRS.from_epsg(32614))
    assert (tmp_path / "b.laz").read_bytes() == file.read_bytes()


def test_an_empty_cloud_is_a_file(tmp_path):
    none = np.zeros((0, 3))
    write_laz(tmp_path / "a.laz", none, RGB[:0], UP[:0], CRS.from_epsg(32614))
    assert (tmp_path / "a.laz").read_bytes()[:4] == b"LASF"
