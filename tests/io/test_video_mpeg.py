"""The plan names further video streams of MPEG transport and program streams."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config.schema import Config
from pipeline.io import video_mpeg
from pipeline.plan.scan import scan
from tests.plans import make_plan


def movie(path: Path, frames: int = 12) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"mpg2"), 25, (160, 120)
    )
    for _ in range(frames):
        writer.write(rng.integers(0, 255, (120, 160, 3), np.uint8))
    writer.release()
    return path


def crc(data: bytes) -> bytes:
    """The checksum of MPEG's tables."""
    value = 0xFFFFFFFF
    for byte in data:
        value ^= byte << 24
        for _ in range(8):
            value = (value << 1 ^ (0x04C11DB7 if value >> 31 else 0)) & 0xFFFFFFFF
    return value.to_bytes(4, "big")


def with_stream(data: bytes, kind: int) -> bytes:
    """A transport stream whose maps of programs list one stream more, of type ``kind``."""
    found = bytearray(data)
    for start in range(0, len(data), video_mpeg.PACKET):
        if data[start + 1 : start + 3] != b"\x50\x00":  # FFmpeg's number for the map.
            continue
        at = start + 5 + data[start + 4]
        length = int.from_bytes(data[at + 1 : at + 3], "big") & 0xFFF
        table = bytearray(data[at : at + 3 + length - 4]) + bytes([kind, 0xE1, 0x55, 0xF0, 0])
        table[1:3] = (0xB000 | (length + 5)).to_bytes(2, "big")
        table += crc(bytes(table))
        found[at : at + len(table)] = table
    return bytes(found)


@pytest.mark.parametrize("name", ["walk.mts", "walk.mpg"])
def test_one_stream_needs_no_warning(tmp_path, name):
    movie(tmp_path / name)
    found = scan(tmp_path, "s", Config(), cache=None)
    assert (found.videos[0].width, found.videos[0].height) == (160, 120)
    assert found.warnings == ()


@pytest.mark.parametrize("before", [0, 4])
def test_a_second_stream_of_a_transport_stream_is_named(tmp_path, before):
    """Also in the packets of cameras (.m2ts), which have a time before them."""
    path = movie(tmp_path / "walk.mts")
    data = with_stream(path.read_bytes(), 0x1B)
    if before:
        packets = [data[i : i + 188] for i in range(0, len(data), 188)]
        data = b"".join(bytes(before) + packet for packet in packets)
    path.write_bytes(data)
    found = scan(tmp_path, "s", Config(), cache=None)
    (warning,) = found.warnings
    assert warning.startswith("walk.mts: 2 video streams, of which the first is used")
    (decision,) = make_plan(found, Config()).stages["decode"].decisions
    assert "frames of 160x120" in decision
    assert decision.endswith("the first of 2 video streams")


def test_a_second_stream_of_a_program_stream_is_named(tmp_path):
    path = movie(tmp_path / "walk.mpg")
    packet = bytes([0, 0, 1, 0xE1, 0, 3, 0x0F, 0, 0])
    data = path.read_bytes()  # FFmpeg's packets have 2048 bytes.
    path.write_bytes(data[:2048] + packet + data[2048:])
    (warning,) = scan(tmp_path, "s", Config(), cache=None).warnings
    assert warning.startswith("walk.mpg: 2 video streams, of which the first is used")


def test_sound_is_no_video_stream(tmp_path):
    path = movie(tmp_path / "walk.mts")
    path.write_bytes(with_stream(path.read_bytes(), 0x0F))
    assert len(video_mpeg.read_header(io.BytesIO(path.read_bytes())).tracks) == 1


@given(st.binary(max_size=800), st.sampled_from([b"", b"\0\0\1\xba", b"\x47" * 600]))
def test_any_bytes_are_read_or_refused(data, start):
    # ``choose_track`` leaves files with these errors to FFmpeg.
    with contextlib.suppress(ValueError, IndexError):
        video_mpeg.read_header(io.BytesIO(start + data))
