"""Which photographs are panoramas: GPano metadata, 360 degree cameras, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pipeline.io.panorama import panorama_of
from pipeline.io.photofile import read_facts

SPHERE = b'<a GPano:ProjectionType="equirectangular"'
ELEMENT = b"<GPano:ProjectionType>equirectangular</GPano:ProjectionType>"
CROPPED = b" GPano:FullPanoWidthPixels='4000' GPano:CroppedAreaImageWidthPixels='2000'/>"
WHOLE = b" GPano:FullPanoWidthPixels='4000' GPano:CroppedAreaImageWidthPixels='4000'/>"


@pytest.mark.parametrize(
    "xmp, body, size, expected",
    [
        (SPHERE + WHOLE, "", (4000, 2000), "full"),
        (ELEMENT, "", (4000, 2000), "full"),
        (SPHERE + CROPPED, "", (2000, 1000), "partial"),
        (SPHERE + WHOLE, "", (4000, 900), "partial"),
        (b'GPano:ProjectionType="cylindrical"', "RICOH THETA S", (4000, 2000), "no"),
        (b"", "RICOH THETA S", (2688, 1344), "full"),
        (b"", "RICOH THETA S", (2688, 1000), "no"),
        (b"", "Canon EOS R5", (4000, 2000), "maybe"),
        (b"", "", (200, 100), "no"),
        (b"", "", (4000, 3000), "no"),
    ],
)
def test_classification(xmp: bytes, body: str, size: tuple[int, int], expected: str) -> None:
    assert panorama_of(xmp, body, *size) == expected


@given(st.binary(max_size=200), st.integers(1, 10**9))
def test_damaged_metadata_is_no_error(xmp: bytes, number: int) -> None:
    digits = str(number).encode() * 30
    crop = b" GPano:FullPanoWidthPixels='" + digits + b"' GPano:CroppedAreaImageWidthPixels='"
    assert panorama_of(SPHERE + crop + xmp, "", 2000, 1000) in ("full", "partial")
    assert panorama_of(xmp, "", 30, 20) == "no"


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_metadata_is_found_in_files(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    more: dict = {"xmp": b"<x>" + SPHERE + b"/></x>"}
    if suffix == "png":
        from PIL.PngImagePlugin import PngInfo

        info = PngInfo()
        info.add_itxt("XML:com.adobe.xmp", more.pop("xmp").decode())
        more = {"pnginfo": info}
    Image.new("RGB", (64, 32)).save(path, **more)
    assert read_facts(path).panorama == "full"
    Image.new("RGB", (64, 32)).save(path)
    assert read_facts(path).panorama == "no"
