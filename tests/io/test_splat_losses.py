"""What a format does not hold is said on every path that writes Gaussians."""

from __future__ import annotations

from pathlib import Path

import pytest

import splatmake
from pipeline.commands import convert
from pipeline.io.splat_files import SUFFIXES, is_antialiased, read_gaussians, write_gaussians
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
    convert(source, target, 3, 0.0, False, warnings)
    return warnings


@pytest.mark.parametrize("way", ["function", "python", "convert"])
def test_gaussians_out_of_range_are_counted_on_every_path(tmp_path: Path, way: str) -> None:
    (said,) = through(way, tmp_path, tmp_path / "a.spz", tiny_scene())
    assert "a.spz: 40 of 40 Gaussians are too small or too large" in said


@pytest.mark.parametrize("way", ["function", "python", "convert"])
def test_dropped_harmonics_are_said_on_every_path(tmp_path: Path, way: str) -> None:
    (said,) = through(way, tmp_path, tmp_path / "a.splat", sample(40, 2))
    assert "(degree 2) are left out" in said


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_a_format_holds_is_no_warning(tmp_path: Path, suffix: str) -> None:
    assert write_gaussians(tmp_path / f"a{suffix}", sample(40, 0)) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_opacity_compensation_is_kept_or_said(tmp_path: Path, suffix: str) -> None:
    source, target, warnings = tmp_path / "s.spz", tmp_path / f"a{suffix}", []
    write_spz(source, sample(40, 0), antialias=True)
    convert(source, target, 3, 0.0, False, warnings)
    assert len(read_gaussians(target, [])) == 40
    if suffix == ".spz":
        assert is_antialiased(target) and not warnings
    else:
        assert len(warnings) == 1 and "train.antialias" in warnings[0]


@pytest.mark.parametrize("content", [b"", b"\x1f\x8b", b"no gzip", b"NGSP" * 9])
def test_a_file_that_is_none_records_no_compensation(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.spz").write_bytes(content)
    assert not is_antialiased(tmp_path / "a.spz")
