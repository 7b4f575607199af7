"""What a format does not hold is said on every path that writes Gaussians."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import pytest

import splatmake
from pipeline.commands import Wanted, convert
from pipeline.io.splat_files import SUFFIXES, is_antialiased, read_gaussians, write_gaussians
from pipeline.io.splat_losses import RECORDING
from pipeline.io.spz import write_spz
from pipeline.splats.gaussians import Gaussians
from tests.splats.samples import sample


def tiny_scene(degree: int = 0) -> Gaussians:
    """A scene in kilometres: Gaussians below the resolution of SPZ."""
    gaussians = sample(40, degree)
    gaussians.log_scales -= 12
    gaussians.means *= 100
    return gaussians


def through(way: str, tmp_path: Path, target: Path, gaussians: Gaussians) -> list[str]:
    """The warnings of writing ``target`` in this way."""
    if way == "function":
        return write_gaussians(target, gaussians)
    if way == "python":
        with pytest.warns(UserWarning) as caught:
            splatmake.write_gaussians(target, gaussians)
        return [str(warning.message) for warning in caught]
    source, warnings = tmp_path / "source.npz", []
    write_gaussians(source, gaussians)
    convert(source, target, 3, 0.0, False, 3, Wanted(), warnings)
    return warnings


@pytest.mark.parametrize("way", ["function", "python", "convert"])
def test_gaussians_out_of_range_are_counted_on_every_path(tmp_path: Path, way: str) -> None:
    (said,) = through(way, tmp_path, tmp_path / "a.spz", tiny_scene())
    assert "a.spz: 40 of 40 Gaussians are too small or too large" in said


@pytest.mark.parametrize("way", ["function", "python", "convert"])
def test_dropped_harmonics_are_said_on_every_path(tmp_path: Path, way: str) -> None:
    (said,) = through(way, tmp_path, tmp_path / "a.splat", sample(40, 2))
    assert "(degree 2) are left out" in said


@pytest.mark.parametrize("way", ["function", "python", "convert"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_clamped_colours_are_said_on_every_path_or_kept(
    tmp_path: Path, way: str, suffix: str
) -> None:
    gaussians, target = sample(40, 0), tmp_path / f"a{suffix}"
    gaussians.sh[:10] = 7.0  # SH_C0 * 7 is about 2.
    if suffix in (".spz", ".splat"):
        (said,) = through(way, tmp_path, target, gaussians)
        assert "a" + suffix in said and "25%" in said and "clamped" in said
    else:
        assert write_gaussians(target, gaussians) == []
        assert (read_gaussians(target, []).sh - gaussians.sh).abs().max() < 1e-5


def test_clamped_harmonics_of_spz_are_said(tmp_path: Path) -> None:
    gaussians = sample(40, 1)
    gaussians.sh[:, 1:] = 0.9
    assert write_gaussians(tmp_path / "a.spz", gaussians) == []
    gaussians.sh[:20, 2] = -1.3
    (said,) = write_gaussians(tmp_path / "a.spz", gaussians)
    assert "50%" in said and "clamped" in said


def degree_four(flags: int) -> bytes:
    """An SPZ file, version 3, of one Gaussian with the harmonics of degree 4."""
    body = bytes(9) + b"\xff" + b"\x80" * 3 + b"\x80" * 3 + bytes(4) + b"\x80" * 72
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 4, 12, flags, 0)
    return gzip.compress(header + body)


@pytest.mark.parametrize("flags", [0, 2])
def test_what_is_not_read_of_an_spz_file_is_said(tmp_path: Path, flags: int) -> None:
    source, warnings = tmp_path / "s.spz", []
    source.write_bytes(degree_four(flags))
    convert(source, tmp_path / "a.ply", 3, 0.0, False, 3, Wanted(), warnings)
    (said,) = warnings
    assert "s.spz: spherical harmonics of degree 4" in said
    assert ("extensions" in said) == bool(flags)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_a_format_holds_is_no_warning(tmp_path: Path, suffix: str) -> None:
    assert write_gaussians(tmp_path / f"a{suffix}", sample(40, 0)) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_opacity_compensation_is_kept_or_said(tmp_path: Path, suffix: str) -> None:
    source, target, warnings = tmp_path / "s.spz", tmp_path / f"a{suffix}", []
    write_spz(source, sample(40, 0), antialias=True)
    convert(source, target, 3, 0.0, False, 3, Wanted(), warnings)
    assert len(read_gaussians(target, [])) == 40
    if suffix in RECORDING:
        assert is_antialiased(target) and not warnings
    else:
        assert len(warnings) == 1 and "train.antialias" in warnings[0]


@pytest.mark.parametrize("content", [b"", b"\x1f\x8b", b"no gzip", b"NGSP" * 9])
def test_a_file_that_is_none_records_no_compensation(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.spz").write_bytes(content)
    assert not is_antialiased(tmp_path / "a.spz")
