"""Point clouds of other programs: every format gives its points; hostile files one clear error."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.io.clouds import files
from pipeline.io.clouds.files import count_points, read_clouds
from pipeline.io.clouds.text_points import MAX_LINE
from pipeline.runtime.errors import UserError
from tests.io.clouds.written import write_e57, write_las, write_ply, write_text

# In UTM coordinates, beyond the precision of float32.
RNG = np.random.default_rng(0)
XYZ = np.array([544256.0, 5320919.0, 430.0]) + RNG.uniform(-5, 5, (500, 3))
RGB = RNG.integers(0, 256, (500, 3)).astype(np.uint8)
COUNTED = (".ply", ".las", ".laz", ".e57")


def write(path: Path, rgb: np.ndarray | None = RGB) -> Path:
    suffix = path.suffix
    if suffix == ".ply":
        write_ply(path, XYZ, rgb)
    elif suffix in (".las", ".laz"):
        write_las(path, XYZ, rgb)
    elif suffix == ".e57":
        pytest.importorskip("pye57")
        write_e57(path, XYZ, rgb, shift=np.floor(XYZ[0]))
    else:
        write_text(path, XYZ, rgb, "," if suffix == ".csv" else " ")
    return path


def assert_same(path: Path, rgb: np.ndarray | None = RGB, atol: float = 1e-4) -> None:
    cloud = read_clouds([path])
    assert len(cloud) == cloud.num_read == len(XYZ)
    np.testing.assert_allclose(cloud.xyz, XYZ, rtol=0, atol=atol)
    assert cloud.coloured.all() == (rgb is not None)
    if rgb is not None:
        assert (cloud.rgb == rgb).all()


@pytest.fixture
def in_this_process(monkeypatch):
    """Files are read in this process, which is faster."""
    monkeypatch.setattr(files, "run_limited", lambda limits, function, *args: function(*args))


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("coloured", [True, False])
@pytest.mark.parametrize("suffix", [".ply", ".las", ".laz", ".e57", ".xyz", ".csv", ".pts", ".LAZ"])
def test_every_format_gives_its_points(tmp_path, suffix, coloured):
    rgb = RGB if coloured else None
    path = write(tmp_path / f"points{suffix.lower()}", rgb).rename(tmp_path / f"p{suffix}")
    assert_same(path, rgb)
    assert count_points(path) == (len(XYZ) if suffix.lower() in COUNTED else None)


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_ply_of_any_byte_order_and_precision(tmp_path, form, kind):
    write_ply(tmp_path / "p.ply", XYZ, RGB, form, kind)
    assert_same(tmp_path / "p.ply", atol=0.3 if kind == "float" else 1e-9)


def test_eight_bit_colours_in_las(tmp_path):
    write_las(tmp_path / "p.las", XYZ, RGB, bits=8)
    assert_same(tmp_path / "p.las")


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(
    ("name", "text", "colour"),
    [
        ("p.xyz", "# made by a scanner\n1 2 3 10 20 30\n", (10, 20, 30)),
        ("p.xyz", "1 2 3 10 20 30 0.5\n", (10, 20, 30)),
        ("p.xyz", "1 2 3 0.5\n", None),
        ("p.xyz", "1\t2\t3\n", None),
        ("p.xyz", "1 2 3 0.1 -0.7 0.7\n", None),  # normals
        ("p.xyz", "1 2 3 1.0 0.2 0\n", (255, 51, 0)),
        ("p.xyz", "1 2 3 65535 257 0\n", (255, 1, 0)),
        ("p.pts", "1\n1 2 3 -1200 10 20 30\n1\n1 2 3 -1200 10 20 30", (10, 20, 30)),
        ("p.csv", "\ufeffX,Y,Z,Intensity,R,G,B\r\n1,2,3,.5,10,20,30\r\n", (10, 20, 30)),
        ("p.csv", "Blue;Green;Red;Z;Y;X\n30;20;10;3;2;1\n", (10, 20, 30)),
        ("p.csv", "//X Y Z R G B\n1 2 3 10 20 30\n", (10, 20, 30)),
        ("p.csv", '"easting", "northing", "height"\n1, 2, 3\n', None),
    ],
)
def test_text_of_any_layout(tmp_path, name, text, colour):
    (tmp_path / name).write_text(text, encoding="utf-8")
    cloud = read_clouds([tmp_path / name])
    assert cloud.xyz.tolist() == [[1, 2, 3]]
    assert cloud.coloured.tolist() == [colour is not None]
    if colour:
        assert cloud.rgb[0].tolist() == list(colour)


def test_files_of_a_folder_are_one_cloud(tmp_path):
    paths = [tmp_path / "a.laz", tmp_path / "b.xyz"]
    write_las(paths[0], XYZ[:300], RGB[:300])
    write_text(paths[1], XYZ[300:], None)
    cloud = read_clouds(paths)
    assert len(cloud) == 500 and cloud.coloured.sum() == 300


@pytest.mark.parametrize("suffix", [".ply", ".las", ".laz", ".e57", ".xyz"])
def test_a_truncated_file_is_one_error(tmp_path, suffix):
    path = write(tmp_path / f"points{suffix}")
    data = path.read_bytes()
    for share in (0.0, 0.01, 0.3, 0.8):
        path.write_bytes(data[: int(share * len(data))])
        if suffix == ".xyz" and share > 0.1:
            continue  # A shorter text is a smaller cloud.
        with pytest.raises(UserError) as caught:
            read_clouds([path])
        assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("p.ply", b"ply\nformat ascii 1.0\nelement vertex " + b"9" * 5000 + b"\n", "vertex"),
        ("p.ply", b"ply\nformat ascii 1.0\nelement vertex 99999999999\n", "99999999999 lines"),
        ("p.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\n", "bytes"),
        ("p.xyz", b"1 " * MAX_LINE, "lines"),
        ("p.xyz", b"1 2\n", "x, y and z"),
        ("p.xyz", b"1 2 3\n4 5\n", "same number"),
        ("p.xyz", b"1 2 3\n4 5 six\n", "six"),
        ("p.xyz", b"nan nan nan\ninf 1 2\n", "finite"),
        ("p.xyz", b"9" * 5000 + b" 1 2\n", "finite"),
        ("p.xyz", b"", "found none"),
        ("p.xyz", b"\x00\xff" * 99, "x, y and z"),
        ("p.csv", b"x,y,z\n1,,2\n", "same number"),
        ("p.csv", b"1,5;2,5;3,5\n", "same number"),
        ("p.las", b"LASF", "LAS or LAZ"),
        ("p.e57", b"ASTM-E57" + b"\xff" * 2000, "E57 file"),
    ],
)
def test_a_hostile_file_is_one_error(tmp_path, name, content, match):
    if name == "p.ply" and content.endswith(b"9\n"):
        content += b"property float x\nproperty float y\nproperty float z\nend_header\n"
    path = tmp_path / name
    path.write_bytes(content)
    start = time.monotonic()
    with pytest.raises(UserError, match=match):
        read_clouds([path])
    assert time.monotonic() - start < 30


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("count", [501, 10**6, 2**32 - 1])
def test_a_las_that_claims_more_points_than_it_has(tmp_path, suffix, count):
    path = write(tmp_path / f"p{suffix}")
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 107, count)
    path.write_bytes(data)
    with pytest.raises(UserError):
        read_clouds([path])


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("field", "offset", "value"),
    [
        ("<I", 96, 0),  # where the points begin
        ("<I", 100, 2**32 - 1),  # number of variable length records
        ("<H", 94, 65535),  # size of the header
        ("<H", 105, 0),  # size of a point
        ("<B", 104, 63),  # format of the points
        ("<I", 243, 2**32 - 1),  # number of extended records
        ("<Q", 247, 2**63),  # number of points
    ],
)
def test_a_las_header_that_lies_is_one_error_at_once(tmp_path, suffix, field, offset, value):
    path = tmp_path / f"p{suffix}"
    write_las(path, XYZ, None, version="1.4")
    data = bytearray(path.read_bytes())
    struct.pack_into(field, data, offset, value)
    path.write_bytes(data)
    start = time.monotonic()
    with pytest.raises(UserError):
        read_clouds([path])
    assert time.monotonic() - start < 30


def test_a_small_laz_that_expands_to_much_is_refused(tmp_path):
    same = np.zeros((300_000, 3))
    write_las(tmp_path / "p.laz", same, None)
    with pytest.raises(UserError, match="300000"):
        read_clouds([tmp_path / "p.laz"])


@pytest.mark.usefixtures("in_this_process")
@given(st.data())
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_flipped_bytes_give_points_or_one_error(tmp_path, data):
    """Of text and PLY, which have no native reader."""
    suffix = data.draw(st.sampled_from([".ply", ".xyz", ".pts", ".csv"]))
    path = write(tmp_path / f"p{suffix}")
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 8))):
        at = data.draw(st.integers(0, min(len(content), 400) - 1))
        content[at] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        cloud = read_clouds([path])
    except UserError as error:
        assert str(path) in str(error)
    else:
        assert np.isfinite(cloud.xyz).all()


@pytest.mark.parametrize("suffix", [".laz", ".e57"])
def test_a_damaged_body_does_not_end_the_program(tmp_path, suffix):
    path = write(tmp_path / f"p{suffix}")
    content = bytearray(path.read_bytes())
    rng = np.random.default_rng(1)
    for k in range(4):
        damaged = bytearray(content)
        for at in rng.integers(40, len(content), 40 * (k + 1)):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            cloud = read_clouds([path])
        except UserError:
            continue
        assert np.isfinite(cloud.xyz).all()
