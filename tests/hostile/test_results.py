"""Damaged caches and results, interrupts, folders that cannot be written."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.command import main as command
from pipeline.config.schema import Config
from pipeline.io.npz import read_npz, write_npz
from pipeline.io.splat_files import read_gaussians, write_gaussians
from pipeline.plan.scan import Scan, scan
from pipeline.runtime import job as jobs
from pipeline.runtime.errors import EXIT_INTERRUPTED, EXIT_USER_ERROR, UserError
from pipeline.runtime.job import Job, Request, run_stage
from pipeline.runtime.layout import SCAN_CACHE
from tests.pictures import photos, picture
from tests.splats.samples import sample


def look(folder: Path, cache: Path) -> Scan:
    return scan(folder, folder.name, Config(), cache=cache)


def request(tmp_path: Path) -> Request:
    key = {"config": {}, "seed": None}
    return Request("work", key, {}, tmp_path / "results" / "x" / "work", 1, None, {})


# --- the scan's cache ----------------------------------------------------------------------------

WRONG: list[object] = [None, 3, [], {}, "x", [1, 2], {"width": "x"}, {"digest": 3}, [[[]]]]


@pytest.mark.parametrize("value", WRONG, ids=json.dumps)
def test_a_wrong_value_in_the_scans_cache_is_computed_again(tmp_path, value):
    photos(tmp_path / "s" / "images", 2)
    photos(tmp_path / "s" / "masks", 2, mode="L")
    cache = tmp_path / "scan.json"
    expected = look(tmp_path / "s", cache)
    content = json.loads(cache.read_text())
    for entry in content["files"].values():
        entry[1] = value
    cache.write_text(json.dumps(content))
    # A text is the reason why a photograph cannot be read.
    if isinstance(value, str):
        with pytest.raises(UserError, match="none of the 2 photographs"):
            look(tmp_path / "s", cache)
    else:
        assert look(tmp_path / "s", cache) == expected


@pytest.mark.parametrize(
    "text", ["", "[]", "3", '{"version": 5}', '{"version": 5, "files": 3}', "[" * 100_000, "\0"]
)
def test_a_damaged_cache_is_ignored(tmp_path, text):
    photos(tmp_path / "s" / "images", 2)
    cache = tmp_path / "scan.json"
    cache.write_text(text)
    assert len(look(tmp_path / "s", cache).photos) == 2


def test_a_photograph_replaced_at_equal_size_and_times(tmp_path, monkeypatch):
    """Some network file systems have no change time: the inode tells."""
    real = os.stat

    def stat(path: str | Path, **options: bool) -> os.stat_result:
        found = real(path, **options)
        fields = {name: getattr(found, name) for name in dir(found) if name.startswith("st_")}
        return os.stat_result(tuple(found), fields | {"st_ctime_ns": 0, "st_mtime_ns": 0})

    first, other = photos(tmp_path / "s" / "images", 2)
    size = max(first.stat().st_size, other.stat().st_size)
    for path in (first, other):
        path.write_bytes(path.read_bytes().ljust(size, b"\0"))
    cache = tmp_path / "scan.json"
    monkeypatch.setattr(os, "stat", stat)
    before = look(tmp_path / "s", cache)
    shutil.copy(other, tmp_path / "new.jpg")
    (tmp_path / "new.jpg").replace(first)
    after = look(tmp_path / "s", cache)
    assert before.fingerprint != after.fingerprint
    assert after.photos[0].digest == after.photos[1].digest


def test_the_remedy_for_a_wrong_digest_in_the_cache_holds(tmp_path, capfd):
    """Running the same command again: the stage that finds the difference drops the cache."""
    photos(tmp_path / "s" / "images", 2)
    cache = tmp_path / "results" / "x" / SCAN_CACHE
    right = look(tmp_path / "s", cache).fingerprint
    content = cache.read_text()
    digest = look(tmp_path / "s", cache).photos[0].digest
    cache.write_text(content.replace(digest, "0" * len(digest)))
    wrong = look(tmp_path / "s", cache)
    assert wrong.fingerprint != right

    def work(job: Job) -> None:
        from pipeline.io.recorded import read_recorded

        read_recorded(wrong.photos[0].path, wrong.photos[0].digest)

    assert run_stage(request(tmp_path), work) == EXIT_USER_ERROR
    assert "run the same command again" in capfd.readouterr().err
    assert look(tmp_path / "s", cache).fingerprint == right


# --- interrupts and missing permissions -----------------------------------------------------------


def test_an_interrupted_stage_ends_without_a_traceback(tmp_path, capfd):
    def work(job: Job) -> None:
        (job.out / "half").write_text("half")
        raise KeyboardInterrupt

    assert run_stage(request(tmp_path), work) == EXIT_INTERRUPTED
    assert capfd.readouterr().err == "work: interrupted\n"
    assert not list((tmp_path / "results").rglob("half"))


def test_an_interrupted_command_ends_without_a_traceback(monkeypatch, capfd):
    def interrupted(**_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "_doctor", interrupted)
    assert command.main(["doctor"]) == EXIT_INTERRUPTED
    assert capfd.readouterr().err == "interrupted\n"


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES, errno.ENOSPC])
def test_results_that_cannot_be_written(tmp_path, monkeypatch, capfd, code):
    def mkdir(path: Path, *_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code), str(path))

    monkeypatch.setattr(jobs.Path, "mkdir", mkdir)
    assert run_stage(request(tmp_path), lambda job: None) == EXIT_USER_ERROR
    said = capfd.readouterr().err
    assert "what to do" in said and "Traceback" not in said


# --- files of Gaussians --------------------------------------------------------------------------


def lying(path: Path) -> None:
    """An array that claims 1.1 TiB."""
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (100000000000, 3), }".ljust(117)
    data = b"\x93NUMPY\x01\x00" + len(header + b"\n").to_bytes(2, "little") + header + b"\n"
    import zipfile

    with zipfile.ZipFile(path, "w") as file:
        for name in sample(2).arrays():
            file.writestr(f"{name}.npy", data)


def without(name: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        arrays = sample(3).arrays()
        del arrays[name]
        np.savez(path, **arrays)  # type: ignore[arg-type]

    return write


def changed(**arrays: np.ndarray) -> Callable[[Path], None]:
    return lambda path: np.savez(path, **(sample(3).arrays() | arrays))  # type: ignore[arg-type]


NPZ: dict[str, Callable[[Path], object]] = {
    "1.1-TiB": lying,
    "no-bands": changed(sh=np.zeros((3, 0, 3), np.float32)),
    "two-bands": changed(sh=np.zeros((3, 2, 3), np.float32)),
    "flat-bands": changed(sh=np.zeros(9, np.float32)),
    "scalar": changed(means=np.float32(1)),
    "pickle": changed(means=np.array([{}], object)),
    "text": changed(means=np.array(["x"])),
    "complex": changed(means=np.zeros((3, 3), complex)),
    "missing": without("sh"),
    "no-gaussians": lambda path: write_npz(path, sample(0)),
    "not-an-archive": lambda path: path.write_bytes(b"PK\x03\x04"),
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.parametrize("case", NPZ)
def test_a_bad_file_of_gaussians_is_one_message(tmp_path, capfd, case):
    file = tmp_path / "g.npz"
    NPZ[case](file)
    with pytest.raises(UserError) as caught:
        read_gaussians(file, [])
    assert caught.value.file == file and caught.value.fix
    assert command.main(["convert", str(file), str(tmp_path / "g.ply")]) == EXIT_USER_ERROR
    assert "error: " in capfd.readouterr().err
    assert not (tmp_path / "g.ply").exists()


CAMERAS: dict[str, dict[str, object]] = {
    "w-nan": {"w": float("nan"), "h": 48},
    "w-infinite": {"w": float("inf"), "h": 48},
    "w-1e9": {"w": 1e9, "h": 1e9, "fl_x": 1e9},
    "w-negative": {"w": -1, "h": 48},
    "translation-1e308": {"w": 64, "h": 48, "x": 1e308},
    "outside": {"path": "../a.png"},
}


@pytest.mark.parametrize("case", CAMERAS)
def test_cameras_that_cannot_be_rendered_are_one_message(tmp_path, capfd, case):
    fields = dict(CAMERAS[case])
    picture(tmp_path / "a.png")
    folder = tmp_path / "scene"
    folder.mkdir()
    pose = np.eye(4)
    pose[0, 3] = fields.pop("x", 0.0)
    frame = {"file_path": fields.pop("path", "a.png"), "transform_matrix": pose.tolist()}
    content = {"fl_x": 50, "frames": [frame], **fields}
    (folder / "transforms.json").write_text(json.dumps(content))
    write_gaussians(tmp_path / "g.ply", sample(5))
    options = ["--cameras", str(folder), "-o", str(tmp_path / "out")]
    assert command.main(["render", str(tmp_path / "g.ply"), *options]) == EXIT_USER_ERROR
    said = capfd.readouterr().err
    assert "error: " in said and "what to do" in said
    assert not (tmp_path / "out").exists()


def test_the_remedy_for_a_stages_gaussians_names_the_stage(tmp_path):
    """Snakemake knows no ``gaussians.npz``: without it, it makes nothing again."""
    folder = tmp_path / "results" / "x" / "train"
    folder.mkdir(parents=True)
    (folder / ".stage.json").write_text("{}")
    (folder / "gaussians.npz").write_bytes(b"damaged")
    with pytest.raises(UserError, match=r"gaussians\.npz: expected.*\n.*--forcerun train"):
        read_npz(folder / "gaussians.npz")


def test_messages_hold_no_control_characters():
    error = UserError("found \x1b[2J\ud800 and " + "x" * 5000, file="a\nb", fix="rename it")
    assert str(error).startswith("a\\nb: found \\x1b[2J\\ud800 and xxx")
    assert len(str(error)) < 1100
    assert len(str(UserError("\0" * 5000))) < 1100
