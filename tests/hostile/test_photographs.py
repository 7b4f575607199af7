"""Hostile photographs and videos: pipes, lying headers, names, missing permissions."""

from __future__ import annotations

import errno
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.config.schema import Config
from pipeline.io.photofile import MAX_PIXELS, read_facts
from pipeline.io.videofile import read_video_facts
from pipeline.photos.load import read_depth
from pipeline.photos.verify import verify_manifest
from pipeline.plan.scan import Scan, scan
from pipeline.runtime.errors import UserError
from tests.pictures import photos, picture
from tests.videos import write_video


def look(folder: Path, cache: Path | None = None) -> Scan:
    return scan(folder, folder.name, Config(), cache=cache)


def names(found: Scan) -> list[str]:
    return [photo.name for photo in found.photos]


def png_header(width: int, height: int) -> bytes:
    """A PNG of this size by its header, with few pixels."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(100))), (b"IEND", b""))
    )
    return b"\x89PNG\r\n\x1a\n" + chunks


def archive(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("bomb", bytes(1 << 20))


def avif(path: Path) -> None:
    """An AVIF image, which PIL can decode."""
    Image.new("RGB", (64, 48)).save(path, "AVIF")


def postscript(path: Path) -> None:
    """PIL decodes it by running Ghostscript."""
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\n")


BAD: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
    "broken-link": lambda path: path.symlink_to("nowhere"),
    "empty": Path.touch,
    "60000x60000": lambda path: path.write_bytes(png_header(60_000, 60_000)),
    "2147483647x1": lambda path: path.write_bytes(png_header(2**31 - 1, 1)),
    "0x0": lambda path: path.write_bytes(png_header(0, 0)),
    "archive": archive,
    "avif": avif,
    "postscript": postscript,
}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".dng", ".tif", ".webp"])
@pytest.mark.parametrize("kind", BAD)
def test_a_bad_photograph_is_left_out_and_the_others_are_used(tmp_path, kind, suffix):
    good = photos(tmp_path / "images", 2)
    BAD[kind](tmp_path / "images" / f"x{suffix}")
    found = look(tmp_path)
    assert names(found) == [path.name for path in good]
    if kind != "folder":  # It is not listed as a file.
        (warning,) = found.warnings
        assert warning.startswith(f"x{suffix}: left out: cannot be read")


@pytest.mark.parametrize("side", [20_000, 60_000, 2**31 - 1])
def test_an_avif_image_that_claims_a_huge_size_is_left_out(tmp_path, side):
    good = photos(tmp_path / "images", 2)
    file = tmp_path / "images" / "x.avif"
    avif(file)
    data = bytearray(file.read_bytes())
    struct.pack_into(">II", data, data.index(b"ispe") + 8, side, side)
    file.write_bytes(data)
    found = look(tmp_path)
    manifest, warnings = verify_manifest(
        found.manifest, threads=1, min_photos=2, keep_duplicates=True
    )
    assert [photo.name for photo in manifest.photos] == [path.name for path in good]
    assert any("x.avif: left out" in line for line in (*found.warnings, *warnings))


def test_a_photograph_just_too_large_names_the_limit(tmp_path):
    file = tmp_path / "x.png"
    file.write_bytes(png_header(MAX_PIXELS // 1024, 1025))
    with pytest.raises(UserError, match=r"524288x1025 pixels are more than 536 megapixels"):
        read_facts(file)


@pytest.mark.parametrize("kind", ["masks", "depths"])
def test_a_pipe_among_masks_and_depth_maps_is_named(tmp_path, kind):
    photos(tmp_path / "images", 2)
    (tmp_path / kind).mkdir()
    os.mkfifo(tmp_path / kind / "p00.png")
    found = look(tmp_path)
    assert found.warnings == (f"{kind}/p00.png is not used: expected a file; remove it",)


@pytest.mark.parametrize("name", ["a\nb.jpg", "a\x1b[2Jb.jpg", "a\tb.jpg", "\x7f.jpg"])
def test_names_with_control_characters_are_left_out(tmp_path, name):
    photos(tmp_path / "images", 2)
    picture(tmp_path / "images" / name)
    found = look(tmp_path)
    assert names(found) == ["p00.jpg", "p01.jpg"]
    (warning,) = found.warnings
    assert "has control characters; rename it" in warning and warning.isprintable()


def test_a_folder_whose_name_has_a_newline(tmp_path):
    photos(tmp_path / "images" / "a\nb", 2)
    photos(tmp_path / "images" / "c", 2)
    assert names(look(tmp_path)) == ["c/p00.jpg", "c/p01.jpg"]


def test_exif_texts_are_printable(tmp_path):
    make, model = 0x010F, 0x0110
    tags = {make: "A\x1b[2J\nB", model: "C\x07"}
    facts = read_facts(picture(tmp_path / "x.jpg", tags=tags, exif={0x9291: "12" * 5000}))
    assert facts.body == "A[2JB C"


# --- missing permissions: root, as which tests may run, has all ----------------------------------


@pytest.fixture
def without_permission(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """Makes a folder unreadable."""
    real = os.scandir

    def deny(folder: Path) -> None:
        def scandir(path: str | Path) -> object:
            if Path(path) == folder:
                raise PermissionError(errno.EACCES, "Permission denied", str(path))
            return real(path)

        monkeypatch.setattr(os, "scandir", scandir)

    return deny


@pytest.mark.parametrize("kind", ["images", "masks", "depths", "videos"])
def test_a_folder_without_permission_is_named(tmp_path, without_permission, kind):
    photos(tmp_path / "images", 2)
    (tmp_path / kind).mkdir(exist_ok=True)
    without_permission(tmp_path / kind)
    with pytest.raises(UserError, match=rf"/{kind}: cannot be read: Permission denied") as caught:
        look(tmp_path)
    assert "permission" in (caught.value.fix or "")


def test_a_subfolder_without_permission_is_a_warning(tmp_path, without_permission):
    photos(tmp_path / "images" / "a", 2)
    photos(tmp_path / "images" / "b", 2)
    without_permission(tmp_path / "images" / "b")
    found = look(tmp_path)
    assert names(found) == ["a/p00.jpg", "a/p01.jpg"]
    assert found.warnings == ("images/b/ is not used: it cannot be read: Permission denied",)


def test_a_scene_folder_that_cannot_be_searched(tmp_path, monkeypatch):
    def is_dir(path: Path) -> bool:
        if path.name == "images":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return os.path.isdir(path)

    monkeypatch.setattr(Path, "is_dir", is_dir)
    with pytest.raises(UserError, match="cannot be read: Permission denied"):
        look(tmp_path)


# --- videos --------------------------------------------------------------------------------------


def avi(path: Path, **fields: tuple[int, int]) -> Path:
    """A small AVI file with (offset, value) of header fields replaced."""
    frames = np.random.default_rng(0).integers(0, 255, (6, 48, 64, 3), np.uint8)
    write_video(path, list(frames))
    data = bytearray(path.read_bytes())
    for tag, value in fields.values():
        struct.pack_into("<I", data, tag, value)
    path.write_bytes(data)
    return path


def header_at(path: Path, tag: bytes, offset: int) -> int:
    return path.read_bytes().index(tag) + 8 + offset


def test_a_video_that_claims_a_billion_frames(tmp_path):
    file = avi(tmp_path / "clip.avi")
    avi(
        file,
        total=(header_at(file, b"avih", 16), 10**9),
        length=(header_at(file, b"strh", 32), 10**9),
    )
    found = look(tmp_path)
    assert len(found.with_frames(150).frames) <= 150
    manifest, _ = verify_manifest(found.manifest, threads=1, min_photos=0, keep_duplicates=True)
    assert len(manifest.videos) == 1


def test_a_video_with_too_large_frames_is_left_out(tmp_path, monkeypatch):
    photos(tmp_path / "images", 2, (8, 6))
    avi(tmp_path / "clip.avi")
    monkeypatch.setattr("pipeline.io.photofile.MAX_PIXELS", 64 * 48 - 1)
    found = look(tmp_path)
    assert found.videos == ()
    assert "clip.avi: left out: cannot be read as a video: 64x48 pixels" in found.warnings[0]


def test_a_video_whose_container_claims_huge_frames(tmp_path):
    """The frames' own headers count."""
    file = avi(tmp_path / "clip.avi")
    at = header_at(file, b"strf", 4)
    avi(file, width=(at, 100_000), height=(at + 4, 100_000))
    (video,) = look(tmp_path).videos
    assert (video.width, video.height) == (64, 48)


@pytest.mark.parametrize("kind", ["pipe", "device", "empty", "archive", "60000x60000"])
def test_a_bad_video_is_left_out(tmp_path, kind):
    photos(tmp_path / "images", 2)
    BAD[kind](tmp_path / "clip.mp4")
    found = look(tmp_path)
    assert found.videos == ()
    assert found.warnings[0].startswith("clip.mp4: left out: cannot be read")
    if kind not in ("pipe", "device"):
        with pytest.raises(UserError, match=r"clip\.mp4: cannot be read as a video"):
            read_video_facts(tmp_path / "clip.mp4")


# --- depth maps ----------------------------------------------------------------------------------


def pickled(path: Path) -> None:
    np.save(path, np.array([{"a": 1}], object), allow_pickle=True)


def lying(path: Path) -> None:
    np.save(path, np.zeros((3, 3)))
    path.write_bytes(path.read_bytes().replace(b"(3, 3)", b"(3000000000, 3000000000)"))


def lying_archive(path: Path) -> None:
    np.savez_compressed(path, depth=np.zeros((4000, 4000)))


DEPTHS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "pickle": (".npy", pickled),
    "1e19-values": (".npy", lying),
    "empty": (".npy", Path.touch),
    "text": (".npy", lambda path: path.write_text("depth")),
    "bomb": (".npz", lying_archive),
    "no-array": (".npz", lambda path: zipfile.ZipFile(path, "w").close()),
    "text-archive": (".npz", lambda path: path.write_text("depth")),
}


@pytest.mark.parametrize("kind", DEPTHS)
def test_a_bad_depth_map_is_named(tmp_path, kind):
    suffix, write = DEPTHS[kind]
    file = tmp_path / f"d{suffix}"
    write(file)
    with pytest.raises(UserError, match=r"the depth map cannot be read"):
        read_depth(file)
