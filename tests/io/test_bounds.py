"""Files that have no end, or take much more memory than their size, are one error at once."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.io.colmap import read_model
from pipeline.io.exr import read_header
from pipeline.io.photofile import read_facts
from pipeline.io.poses.files import read_json, read_xml
from pipeline.io.splat_files import SUFFIXES, read_gaussians
from pipeline.runtime.errors import UserError

KINDS = ("pipe", "device", "sparse")


def endless(path: Path, kind: str) -> Path:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.touch()
        os.truncate(path, 1 << 42)
    return path


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_gaussians_without_end(tmp_path, suffix, kind):
    file = endless(tmp_path / f"g{suffix}", kind)
    with pytest.raises(UserError) as caught:
        read_gaussians(file, [])
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_colmap_files_without_end(tmp_path, suffix, kind):
    for name in ("cameras", "images", "points3D"):
        endless(tmp_path / f"{name}.{suffix}", kind)
    with pytest.raises(UserError) as caught:
        read_model(tmp_path)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("read", [read_json, read_xml])
@pytest.mark.parametrize("kind", KINDS)
def test_text_without_end(tmp_path, read, kind):
    file = endless(tmp_path / "a", kind)
    with pytest.raises(UserError, match=r"cannot be read|at most"):
        read(file)


@pytest.mark.parametrize("text", ["[{},", "[[],", "[0,0,"])
def test_json_that_takes_much_memory(tmp_path, text):
    file = tmp_path / "a.json"
    file.write_text("[" + text * (1 << 25))
    with pytest.raises(UserError, match=r"memory|at most"):
        read_json(file)


def test_a_picture_that_takes_much_memory_to_decode(tmp_path):
    file = tmp_path / "a.webp"
    Image.new("L", (16000, 12000)).convert("RGB").save(file, quality=1, method=0)
    with pytest.raises(UserError, match="16000x12000 pixels of WEBP take more than"):
        read_facts(file)


def test_an_exr_that_takes_much_memory_to_decode(tmp_path):
    import OpenEXR

    file = tmp_path / "a.exr"
    channels = {name: np.zeros((8, 8), np.float16) for name in "RGB"}
    channels |= {f"extra{i}": np.zeros((8, 8), np.float16) for i in range(40)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as written:
        written.write(str(file))
    data = file.read_bytes()
    small, large = (np.array([0, 0, n - 1, n - 1], "<i4").tobytes() for n in (8, 8192))
    file.write_bytes(data.replace(small, large))
    with open(file, "rb") as opened, pytest.raises(ValueError, match="43 channels take"):
        read_header(opened)
