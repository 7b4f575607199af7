"""The fingerprint of a scene, and the cache of facts about its files."""

import os
import shutil
from pathlib import Path

import pytest

from tests.pictures import photos
from tests.plan.test_scan import look, write_sparse


@pytest.fixture
def scene(tmp_path) -> Path:
    folder = tmp_path / "scene"
    files = photos(folder / "images", 3)
    photos(folder / "masks", 3, mode="L")
    write_sparse(folder / "sparse" / "0", [path.name for path in files], (64, 48))
    return folder


def test_fingerprint_is_independent_of_times_and_location(scene, tmp_path, monkeypatch):
    before = look(scene).fingerprint
    for path in scene.rglob("*"):
        os.utime(path, (1, 1))
    (scene / "images" / "notes.txt").write_text("no picture")
    assert look(scene).fingerprint == before
    shutil.copytree(scene, tmp_path / "elsewhere")
    assert look(tmp_path / "elsewhere").fingerprint == before
    monkeypatch.chdir(tmp_path)
    assert look(Path("scene")).fingerprint == before


@pytest.mark.parametrize("file", ["images/p01.jpg", "masks/p01.jpg", "sparse/0/images.bin"])
def test_fingerprint_changes_with_one_byte(scene, file, tmp_path):
    cache = tmp_path / "cache.json"
    before = look(scene, cache=cache).fingerprint
    time = (scene / file).stat().st_mtime_ns
    data = bytearray((scene / file).read_bytes())
    # The end of a JPEG's scan, or a keypoint's coordinate: still a readable file.
    data[-20] ^= 1
    (scene / file).write_bytes(data)
    os.utime(scene / file, ns=(time, time))  # as cp -p and rsync do
    assert look(scene, cache=cache).fingerprint != before


def test_fingerprint_changes_with_names(scene):
    before = look(scene).fingerprint
    (scene / "masks" / "p02.jpg").unlink()
    without = look(scene).fingerprint
    (scene / "images" / "p02.jpg").rename(scene / "images" / "p02.jpeg")
    assert len({before, without, look(scene).fingerprint}) == 3


def test_scans_are_equal_with_a_missing_or_damaged_cache(scene, tmp_path):
    cache = tmp_path / "cache.json"
    plain = look(scene)
    assert look(scene, cache=cache) == plain == look(scene, cache=cache)
    assert cache.exists()
    for broken in ("", "[]", '{"version": 2}', '{"version": 2, "files": {"photo:x": 3}}'):
        cache.write_text(broken)
        assert look(scene, cache=cache) == plain
    (tmp_path / "file").write_text("")
    assert look(scene, cache=tmp_path / "file" / "cache.json") == plain


def test_cached_scans_open_no_photograph(scene, tmp_path, monkeypatch):
    look(scene, cache=tmp_path / "cache.json")
    for module in ("companion_files", "photo_folder"):
        name = f"pipeline.plan.{module}.read_facts"
        monkeypatch.setattr(name, lambda path: pytest.fail(f"{path}"))
    look(scene, cache=tmp_path / "cache.json")
