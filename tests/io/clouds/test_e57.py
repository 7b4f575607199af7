"""E57 files: every layout gives its points, as the reference library reads them; no input makes the
reader take another file, the network, or more time and memory than its limits."""

from __future__ import annotations

import json
import math
import resource
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.io.clouds.e57_file import unpacked
from pipeline.io.clouds.e57_points import count_e57, read_e57
from pipeline.io.clouds.files import read_clouds
from pipeline.runtime.errors import UserError
from tests.io.clouds.written_e57 import (
    Column,
    Scan,
    assembled,
    data_packet,
    points_xml,
    section,
    write_scans,
)

PROJECT = Path(__file__).resolve().parents[3]
XYZ = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLOURS = ("colorRed", "colorGreen", "colorBlue")
FLOATS = "".join(f'<{name} type="Float" precision="single"/>' for name in XYZ)


def floats(count: int) -> list[bytes]:
    return [np.arange(count, dtype="<f4").tobytes()] * 3


def one_file(tmp_path: Path, prototype: str, count: int, *fields: bytes) -> Path:
    path = tmp_path / "points.e57"
    path.write_bytes(assembled(points_xml(prototype, count), section(data_packet(*fields))))
    return path


def all_points(path: Path) -> tuple[np.ndarray, list[np.ndarray | None]]:
    chunks = list(read_e57(path))
    return np.concatenate([chunk.xyz for chunk in chunks]), [chunk.colour for chunk in chunks]


@st.composite
def columns(draw: st.DrawFn, count: int, rng: np.random.Generator) -> Column:
    kind = draw(st.sampled_from(["single", "double", "integer", "scaled"]))
    if kind in ("single", "double"):
        values = rng.normal(size=count) * 100
        return Column(values.astype(np.float32 if kind == "single" else float), kind)
    # The library cannot write scaled integers that are all the same.
    bits = draw(st.integers(kind == "scaled", 45))
    low = draw(st.integers(-(2**bits), 2**bits))
    high = low + 2**bits - 1
    whole = rng.integers(low, high + 1, count).astype(float)
    if kind == "integer":
        return Column(whole, kind, low, high)
    scale, offset = draw(st.sampled_from([(1e-3, 0.0), (0.5, -7.25), (1e-5, 1e5)]))
    return Column(whole * scale + offset, kind, low, high, scale, offset)


@st.composite
def scans(draw: st.DrawFn) -> Scan:
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.sampled_from([1, 2, 9, 1000, 30_001]))
    found = {name: draw(columns(count, rng)) for name in draw(st.sampled_from([XYZ, SPHERICAL]))}
    prefix = "cartesian" if "cartesianX" in found else "spherical"
    if draw(st.booleans()):
        found["intensity"] = draw(columns(count, rng))
    if draw(st.booleans()):
        high = draw(st.sampled_from([255, 1023, 65535]))
        for name in COLOURS:
            found[name] = Column(rng.integers(0, high + 1, count).astype(float), "integer", 0, high)
    if draw(st.booleans()):
        state = Column(rng.integers(0, 3, count).astype(float), "integer", 0, 2)
        found[f"{prefix}InvalidState"] = state
    order = draw(st.permutations(list(found)))
    quat = rng.normal(size=4)
    quat = quat / np.linalg.norm(quat)
    shift = rng.normal(size=3) * draw(st.sampled_from([0, 1, 1e6]))
    return Scan({name: found[name] for name in order}, quat.tolist(), shift.tolist())


def expected(path: Path, scan: Scan, index: int) -> tuple[np.ndarray, np.ndarray | None]:
    """A scan's points as the reference library reads the values, and its colours."""
    from pye57 import ScanHeader, libe57

    file = libe57.ImageFile(str(path), "r")
    header = ScanHeader(file.root()["data3D"][index])
    count = header.point_count
    arrays = {name: np.zeros(count) for name in scan.columns}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, count, True, True))
    reader = header.points.reader(buffers)
    assert reader.read() == count
    reader.close()
    names = XYZ if "cartesianX" in arrays else SPHERICAL
    xyz = np.stack([arrays[name] for name in names], axis=1)
    if names is SPHERICAL:
        length, azimuth, elevation = xyz.T
        flat = length * np.cos(elevation)
        parts = [flat * np.cos(azimuth), flat * np.sin(azimuth), length * np.sin(elevation)]
        xyz = np.stack(parts, axis=1)
    xyz = xyz @ header.rotation_matrix.T + header.translation
    state = arrays.get("cartesianInvalidState", arrays.get("sphericalInvalidState"))
    if state is not None:
        xyz[state != 0] = np.nan
    colour = np.stack([arrays[c] for c in COLOURS], 1) if "colorRed" in arrays else None
    return xyz, colour


@given(st.lists(scans(), min_size=1, max_size=3))
@settings(max_examples=30, deadline=None, suppress_health_check=[*HealthCheck])
def test_any_layout_is_read_as_by_the_reference_library(tmp_path, layout):
    pytest.importorskip("pye57")
    path = tmp_path / "points.e57"
    path.unlink(missing_ok=True)
    write_scans(path, layout)
    chunks = list(read_e57(path))
    assert count_e57(path) == sum(len(chunk.xyz) for chunk in chunks)
    for index, (scan, chunk) in enumerate(zip(layout, chunks, strict=True)):
        xyz, colour = expected(path, scan, index)
        scale = np.nanmax(np.abs(xyz), initial=1.0)
        np.testing.assert_allclose(chunk.xyz, xyz, rtol=0, atol=1e-12 * scale)
        assert (chunk.colour is None) == (colour is None)
        assert colour is None or np.array_equal(chunk.colour, colour)


@pytest.mark.parametrize("bits", range(65))
def test_integers_of_any_number_of_bits_at_any_bit(bits):
    rng = np.random.default_rng(bits)
    values = [int.from_bytes(rng.bytes(8), "little") % 2**bits for _ in range(37)]
    for first in range(0, 20, 3):
        whole = sum(value << (first + i * bits) for i, value in enumerate(values))
        data = whole.to_bytes((first + 37 * bits + 7) // 8, "little")
        assert unpacked(data, first, bits, 37).tolist() == values


def test_points_of_several_chunks_and_packets(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.io.clouds.e57_points.CHUNK_POINTS", 7)
    path = tmp_path / "points.e57"
    fields = floats(20)
    # Index packets and empty ones are between those with points; fields are split anywhere.
    packets = data_packet(*(field[:10] for field in fields))
    packets += struct.pack("<BBHH10x", 0, 0, 15, 0) + struct.pack("<BBH", 2, 0, 3)
    packets += data_packet(fields[0][10:], fields[1][10:11], b"") + data_packet(
        b"", fields[1][11:], fields[2][10:]
    )
    path.write_bytes(assembled(points_xml(FLOATS, 20), section(packets)))
    xyz, _ = all_points(path)
    assert [len(chunk.xyz) for chunk in read_e57(path)] == [7, 7, 6]
    np.testing.assert_array_equal(xyz, np.repeat(np.arange(20.0), 3).reshape(20, 3))


def test_names_of_extensions_are_not_those_of_e57(tmp_path):
    """A field of an extension has its bytes, and another meaning."""
    other = '<x:cartesianX xmlns:x="urn:x" type="Float" precision="single"/>'
    text = '<name type="String"/>'
    path = one_file(tmp_path, other + text + FLOATS, 3, bytes(12), b"\x02a", *floats(3))
    xyz, _ = all_points(path)
    assert xyz[:, 0].tolist() == [0, 1, 2]


def test_a_wrong_checksum_is_one_error(tmp_path):
    path = one_file(tmp_path, FLOATS, 300, *floats(300))
    data = bytearray(path.read_bytes())
    for at in (90, 1023, len(data) - 2):
        damaged = bytearray(data)
        damaged[at] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(UserError, match="wrong checksum at"):
            list(read_e57(path))


INTEGERS = "".join(f'<{name} type="Integer" minimum="0" maximum="0"/>' for name in XYZ)
BITS = FLOATS.replace("cartesianX", "x") + '<cartesianX type="Integer" minimum="0" maximum="1"/>'


@pytest.mark.parametrize(
    ("xml", "binary", "match"),
    [
        (points_xml(FLOATS, 3), section(data_packet(*floats(2))), "expected 3 points, found fewer"),
        (points_xml(FLOATS, 3), section(data_packet(*floats(3)[:2])), "packet of 3 fields"),
        (points_xml(FLOATS, 3), section(b"\x01\x00\xff\xff\x03\x00" + b"\xff" * 8), "its end"),
        (points_xml(FLOATS, 3), section(b"\x07" + bytes(15)), "found the type 7"),
        (points_xml(FLOATS, 3), section(bytes(4096), length=2**40), "expected a section"),
        (points_xml(FLOATS, 3), section(b"", first=2**63), "offset in the file"),
        (points_xml(FLOATS, 3), section(data_packet(*floats(3)), first=0), "in their section"),
        (points_xml(FLOATS, 3, offset=-48), b"", "an offset"),
        (points_xml(FLOATS, 3, offset=2**70), b"", "offset in the file"),
        (points_xml(FLOATS, -3), section(b""), "a number of records"),
        (points_xml(FLOATS, 10**12), section(b""), "found a header of 1000000000000 in 1024"),
        (points_xml(INTEGERS, 10**12), section(b""), "found a header of 1000000000000 in 1024"),
        (points_xml(FLOATS, 10**9, scans=500), section(b""), "found a header of 5000"),
        (points_xml(FLOATS.replace("Float", "String"), 3), section(b""), "Cartesian or spherical"),
        (points_xml(INTEGERS.replace('"0"', '"x"'), 3), section(b""), "invalid literal"),
        (points_xml(INTEGERS.replace('"0"', f'"{"9" * 5000}"'), 3), section(b""), "longer text"),
        (points_xml(INTEGERS.replace('maximum="0"', 'maximum="-1"'), 3), b"", "range of integers"),
        (points_xml("<a>" * 5000, 3), b"", "nested too deeply"),
        (b"<e57Root/>", b"", "data3D"),
        (b"<a></a>", b"", "data3D"),
        (b"", b"", "not valid XML"),
    ],
)
def test_a_file_that_lies_is_one_error(tmp_path, xml, binary, match):
    path = tmp_path / "points.e57"
    path.write_bytes(assembled(xml, binary))
    with pytest.raises(UserError, match=match):
        list(read_e57(path))


@pytest.mark.parametrize(
    ("at", "value"), [(16, 2**40), (24, 2**63), (32, 2**40), (40, 512), (40, 0), (16, 0)]
)
def test_a_header_that_lies_is_one_error(tmp_path, at, value):
    path = one_file(tmp_path, FLOATS, 3, *floats(3))
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, at, value)
    path.write_bytes(data)
    with pytest.raises(UserError):
        list(read_e57(path))


CANARY = "the secret of this machine"


@pytest.mark.parametrize(
    "head",
    [
        '<!DOCTYPE e57Root SYSTEM "http://127.0.0.1:{port}/a.dtd">',
        '<!DOCTYPE e57Root PUBLIC "-//x//y" "http://127.0.0.1:{port}/a.dtd">',
        '<!DOCTYPE e57Root [<!ENTITY x SYSTEM "file://{canary}">]>',
        '<!DOCTYPE e57Root [<!ENTITY x SYSTEM "http://127.0.0.1:{port}/">]>',
        '<!DOCTYPE e57Root [<!ENTITY % f SYSTEM "file://{canary}"><!ENTITY % d SYSTEM '
        '"http://127.0.0.1:{port}/a.dtd">%d;]>',
        '<!DOCTYPE e57Root [<!ENTITY x "xxxxxxxxxx">]>',
        "",
    ],
)
@pytest.mark.parametrize("body", ["", "&x;", '<xi:include href="file://{canary}"/>'])
def test_no_file_and_no_network_is_read(tmp_path, head, body):
    canary = tmp_path / "canary"
    canary.write_text(CANARY)
    reached = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=lambda: reached.append(server.accept()[0]), daemon=True)
        thread.start()
        port = server.getsockname()[1]
        text = points_xml(FLOATS, 3).decode().replace("<data3D", f"{body}<data3D")
        text = text.replace(
            '<e57Root type="Structure" ',
            f'{head}<e57Root type="Structure" xmlns:xi="http://www.w3.org/2001/XInclude" '
            f'xmlns:s="http://127.0.0.1:{port}/" '
            f'xsi:schemaLocation="http://127.0.0.1:{port}/ http://127.0.0.1:{port}/a.xsd" '
            'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" ',
        )
        text = text.replace("{port}", str(port)).replace("{canary}", str(canary))
        path = tmp_path / "points.e57"
        path.write_bytes(assembled(text.encode(), section(data_packet(*floats(3)))))
        try:
            cloud = read_clouds([path])
        except UserError as error:
            assert head or body == "&x;"
            assert CANARY not in str(error)
            assert str(path) in str(error)
        else:
            assert not head and body != "&x;"
            assert cloud.xyz[:, 0].tolist() == [0, 1, 2]
        assert not reached


ROOT = b"<e57Root xmlns='http://www.astm.org/COMMIT/E57/2010-e57-v1.0'>"
SMALL = INTEGERS.replace('maximum="0"', 'maximum="1"')
# Files that would take more time or memory than there is.
BOMBS = {
    "nested": lambda: assembled(b"<a>" * 5_000_000),
    "flat": lambda: assembled(ROOT + b"<a/>" * 5_000_000 + b"</e57Root>"),
    "text": lambda: assembled(ROOT + b"x" * (1 << 25) + b"</e57Root>"),
    "attributes": lambda: assembled(
        b"<a " + b" ".join(b'a%d=""' % i for i in range(1_000_000)) + b"/>"
    ),
    "scans": lambda: assembled(points_xml(INTEGERS, 1, scans=50_000), section(b"")),
    "empty packets": lambda: assembled(
        points_xml(FLOATS, 1000), section(struct.pack("<BBH", 2, 0, 3) * 1_000_000)
    ),
    "one field": lambda: assembled(
        points_xml(SMALL, 10**6), section(data_packet(b"\0" * 20_000, b"", b"") * 300)
    ),
    "constant": lambda: assembled(points_xml(INTEGERS, 32_000_000), section(bytes(4_000_000))),
}


def explode(folder: Path) -> None:
    """Read every bomb, and print what became of each and the largest memory of a reading process:
    the children of this one, which no other test has started."""
    found = {}
    for name, made in BOMBS.items():
        path = folder / f"{name}.e57"
        path.write_bytes(made())
        start = time.monotonic()
        try:
            outcome = len(read_clouds([path]))
        except UserError as error:
            outcome = str(error)
        found[name] = (outcome, time.monotonic() - start)
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    print(json.dumps({"found": found, "memory_kb": memory}))


def test_bombs_end_within_a_minute_and_two_gigabytes(tmp_path):
    code = f"from tests.io.clouds.test_e57 import Path, explode; explode(Path({str(tmp_path)!r}))"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=PROJECT, check=True)
    result = json.loads(done.stdout)
    assert result["found"].keys() == BOMBS.keys()
    for name, (outcome, seconds) in result["found"].items():
        assert seconds < 60, name
        if isinstance(outcome, str):
            assert f"{name}.e57" in outcome and len(outcome) < 1000
        else:
            assert outcome == 1, name  # The same point again and again.
    if sys.platform == "linux":
        assert result["memory_kb"] < 2 << 20


def test_the_pose_is_a_rotation(tmp_path):
    path = tmp_path / "points.e57"
    for pose, works in (("<w>2</w>", True), ("<w>0</w>", False), ("<w>nan</w>", False)):
        xml = points_xml(FLOATS, 3).replace(
            b"<points", f"<pose><rotation>{pose}</rotation></pose><points".encode()
        )
        path.write_bytes(assembled(xml, section(data_packet(*floats(3)))))
        if works:
            assert math.isclose(all_points(path)[0][2, 2], 2)
            continue
        with pytest.raises(UserError, match=r"unit quaternion|a number"):
            list(read_e57(path))
