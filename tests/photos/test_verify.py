"""Photographs that cannot be decoded are left out with a warning."""

import pytest

from pipeline.config.schema import Config
from pipeline.photos.verify import verify_photos
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from tests.pictures import photos, picture
from tests.plan.scans import look
from tests.plan.test_scan import write_dng


@pytest.fixture
def manifest(tmp_path):
    photos(tmp_path, 3)
    for name in ("cut_a.jpg", "cut_b.png", "cut_c.tif"):
        file = picture(tmp_path / name)
        file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    write_dng(tmp_path / "good.dng")
    write_dng(tmp_path / "cut_d.dng")
    data = (tmp_path / "cut_d.dng").read_bytes()
    (tmp_path / "cut_d.dng").write_bytes(data[:-3000])
    return scan(tmp_path, "s", Config(), cache=None).manifest


@pytest.mark.parametrize("threads", [1, 3])
def test_damaged_photographs_are_left_out_with_a_warning(manifest, threads):
    broken = {"cut_a.jpg", "cut_b.png", "cut_c.tif", "cut_d.dng"}
    # The scan leaves out files with a truncated header.
    scanned = {photo.name for photo in manifest.photos}
    checked, warnings = verify_photos(manifest, threads=threads)
    assert [photo.name for photo in checked.photos] == [
        "good.dng",
        "p00.jpg",
        "p01.jpg",
        "p02.jpg",
    ]
    assert len(warnings) == len(broken & scanned)
    for name in broken:
        assert sum(name in line for line in checked.warnings) == 1, name
    assert all(line.split(": left out: ")[0] in broken for line in checked.warnings), "by name"


def test_too_few_photographs_is_an_error_that_names_the_damaged_ones(manifest):
    with pytest.raises(UserError, match=r"only 4 of \d photographs") as error:
        verify_photos(manifest, threads=1, min_photos=5)
    assert "cut_a.jpg" in str(error.value)


def test_copies_are_left_out_or_a_warning(tmp_path):
    """A test view with a copy among the training views makes the metrics too good."""
    files = photos(tmp_path, 3)
    (tmp_path / "q.jpg").write_bytes(files[1].read_bytes())
    manifest = scan(tmp_path, "s", Config(), cache=None).manifest
    once, (warning,) = verify_photos(manifest, threads=1)
    assert "(q.jpg = p01.jpg)" in warning and "left out" in warning
    assert [photo.name for photo in once.photos] == ["p00.jpg", "p01.jpg", "p02.jpg"]
    kept, (warning,) = verify_photos(manifest, threads=1, keep_duplicates=True)
    assert "q.jpg = p01.jpg" in warning and warning.startswith("copies of other photographs: 1 (")
    assert len(kept.photos) == 4


def test_a_camera_that_stood_still_is_named_as_the_reason(tmp_path):
    files = photos(tmp_path, 1)
    for name in ("q.jpg", "r.jpg"):
        (tmp_path / name).write_bytes(files[0].read_bytes())
    manifest = scan(tmp_path, "s", Config(), cache=None).manifest
    with pytest.raises(UserError, match=r"only 1 of 3 photographs[\s\S]*stood still"):
        verify_photos(manifest, threads=1, min_photos=2)


def test_a_photograph_replaced_after_the_scan_is_an_error(tmp_path):
    """Its facts, read by the scan, are another picture's."""
    files = photos(tmp_path, 3)
    manifest = scan(tmp_path, "s", Config(), cache=None).manifest
    files[1].write_bytes(files[2].read_bytes())
    with pytest.raises(UserError, match=r"p01\.jpg: has changed since the scene was inspected"):
        verify_photos(manifest, threads=1)


@pytest.mark.parametrize("size", [(1, 4000), (4000, 1), (1, 1), (3, 40)])
def test_a_photograph_of_a_few_pixels_is_left_out_with_its_size(tmp_path, size):
    photos(tmp_path / "images", 4)
    picture(tmp_path / "images" / "thin.png", size)
    manifest, warnings = verify_photos(look(tmp_path).manifest, threads=1)
    assert len(manifest.photos) == 4
    assert warnings == [
        f"thin.png: left out: it is {size[0]}x{size[1]} pixels, expected at least 4 a side"
    ]
