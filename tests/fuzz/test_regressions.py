"""Findings of the fuzzer, by name."""

from __future__ import annotations

import contextlib
import io
import os
import struct
from pathlib import Path

import numpy as np
import pytest

from pipeline.io.arrays import read_archive, read_array
from pipeline.io.ply import read_splat_ply
from pipeline.photos.load import read_depth, read_mask, read_picture
from pipeline.runtime.errors import UserError
from tests.fuzz.campaign import content, judged
from tests.fuzz.clouds import las_seeds, read_las_points
from tests.fuzz.packing import pack_png
from tests.fuzz.pictures import encoded, noise, tiff
from tests.fuzz.readers import READERS
from tests.pictures import photos
from tests.plan.scans import look


def npy(header: str) -> bytes:
    body = f"{header}\n".encode("latin-1")
    return b"\x93NUMPY\x01\x00" + len(body).to_bytes(2, "little") + body + bytes(8)


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1,",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1L), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (True,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "9" * 5000 + ",), }",
        "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '|V0', 'fortran_order': False, 'shape': (1,), }",
        "(" * 4000,
    ],
)
def test_headers_of_numpy_are_python_source(header):
    """numpy's parser raises tokenize.TokenError, which is no ValueError."""
    with pytest.raises(ValueError, match="expected"):
        read_array(npy(header))


def test_an_empty_array_of_huge_sides():
    buffer = io.BytesIO()
    np.save(buffer, np.zeros((0, 3)))
    assert read_array(buffer.getvalue()).shape == (0, 3)
    huge = buffer.getvalue().replace(b"(0, 3)", b"(0, 9223372036854775808)")
    with pytest.raises(ValueError, match="found the shape"):
        read_array(huge)


def test_a_ply_header_with_a_count_of_5000_digits(tmp_path):
    """Python refuses to convert it."""
    (data,) = (files["g.ply"] for files in READERS["ply-ascii"].seeds())
    file = tmp_path / "g.ply"
    file.write_bytes(data.replace(b"vertex 3", b"vertex " + b"9" * 5000))
    with pytest.raises(UserError, match="expected 'element vertex COUNT'"):
        read_splat_ply(file)


def test_a_truncated_heic_picture(tmp_path):
    """pillow-heif raises EOFError."""
    reader = READERS["heic"]
    seeds = list(reader.seeds())
    if not seeds:
        pytest.skip("not run: pillow-heif is missing (pip install pillow-heif)")
    data = content("heic", reader, seeds, 78)["x.heic"]
    file = Path(tmp_path / "x.heic")
    file.write_bytes(data)
    with pytest.raises(UserError, match="not a readable image"):
        read_picture(file)


def test_an_archive_whose_member_claims_to_be_larger_than_the_file() -> None:
    """zipfile asks for the bytes that the entry of the directory claims."""
    buffer = io.BytesIO()
    np.savez(buffer, means=np.zeros((6, 3), np.float32))
    data = bytearray(buffer.getvalue())
    entry = data.index(b"PK\x01\x02")
    data[entry + 20 : entry + 24] = (2_530_607_533).to_bytes(4, "little")
    with pytest.raises(ValueError, match="larger than the file"):
        read_archive(io.BytesIO(bytes(data)))


def test_a_las_file_that_ends_in_a_record(tmp_path) -> None:
    (name, content), *_ = las_seeds()[0].items()
    for end in range(227, len(content), 7):
        file = tmp_path / name
        file.write_bytes(content[:end])
        with contextlib.suppress(UserError):
            read_las_points(file)


def test_a_mask_in_a_folder_whose_name_is_not_utf8(tmp_path) -> None:
    """No digest, manifest or message can hold the name; the inventory names the file."""
    photos(tmp_path / "images", 2)
    folder = os.fsencode(tmp_path / "masks") + b"/\xff"
    os.makedirs(folder)
    os.link(os.fsencode(tmp_path / "images" / "p00.jpg"), folder + b"/p00.jpg")
    found = look(tmp_path)
    assert all(photo.mask is None for photo in found.manifest.photos)
    assert any("not UTF-8" in line for line in found.unused)


@pytest.mark.parametrize("height", [21, 3000, 16_744_448])
def test_a_picture_that_lacks_strips(height, tmp_path) -> None:
    """Pillow takes missing strips for black: 5 GB of them from a file of 1690 bytes."""
    data = bytearray(tiff(noise(4), photometric="rgb", rowsperstrip=4))
    entry = data.index(struct.pack("<H", 257))
    data[entry + 2 : entry + 12] = struct.pack("<HII", 4, 1, height)
    file = tmp_path / "x.tif"
    file.write_bytes(data)
    with pytest.raises(UserError, match=r"lacks a part|a side of more than"):
        read_picture(file)


@pytest.mark.parametrize("height", [40_000, 16_777_200])
def test_a_bitmap_that_claims_to_be_large(height, tmp_path) -> None:
    data = bytearray(encoded(noise(3), ".bmp"))
    data[22:26] = struct.pack("<i", height)
    file = tmp_path / "x.bmp"
    file.write_bytes(data)
    with pytest.raises(UserError, match=r"more than its \d+ bytes hold|a side of more than"):
        read_picture(file)


def test_a_name_of_many_digits(tmp_path) -> None:
    """The message stays short, however long the name is."""
    reader = READERS["colmap-images.bin"]
    for name, data in content("colmap-images.bin", reader, list(reader.seeds()), 1102849).items():
        (tmp_path / name).write_bytes(data)
    with pytest.raises(UserError) as caught:
        reader.read(tmp_path)
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize("read", [read_picture, read_mask])
@pytest.mark.parametrize("height", [20, 16_776_976])
def test_a_png_with_fewer_rows_than_its_header_says(read, height, tmp_path) -> None:
    """Pillow takes the missing rows for black."""
    data = bytearray(encoded(noise(1), ".png"))
    data[20:24] = height.to_bytes(4, "big")
    file = tmp_path / "x.png"
    file.write_bytes(pack_png(bytes(data)))
    with pytest.raises(UserError, match=r"not a readable image|a side of more than"):
        read(file)


def test_a_depth_map_with_a_chunk_that_claims_a_gigabyte(tmp_path) -> None:
    """OpenCV allocates what a PNG file says of the length of a chunk."""
    data = bytearray(encoded(noise(1), ".png"))
    chunk = data.index(b"IDAT")
    data[chunk - 4 : chunk] = struct.pack(">I", 1 << 30)
    case = {"chunk": {"d.png": bytes(data)}}
    assert judged(READERS["depth"], case, tmp_path / "files") == {"chunk": ""}
    with pytest.raises(UserError, match="cannot be read: the image is truncated or damaged"):
        read_depth(tmp_path / "files" / "d.png")
