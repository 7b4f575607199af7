"""The readers that are fuzzed, with small valid files made by the project's writers."""

from __future__ import annotations

import gzip
import io
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.geometry.cameras import CAMERA_MODELS, Camera
from pipeline.io import exr, pillow_formats
from pipeline.io.arrays import read_array
from pipeline.io.camera_paths import read_camera_path
from pipeline.io.colmap import read_model, write_model
from pipeline.io.gcp import read_ground_control
from pipeline.io.llff import read_poses_bounds
from pipeline.io.photofile import read_facts
from pipeline.io.splat_files import read_gaussians, write_gaussians
from pipeline.io.transforms import write_transforms
from pipeline.io.videofile import read_video_facts
from pipeline.photos.load import read_depth, read_picture
from pipeline.plan.given_poses import fit_to_photos, load_given
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Photo
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.views import View
from tests.fuzz.clouds import CLOUDS
from tests.fuzz.georeference import GEOREFERENCE
from tests.fuzz.names import FOLDERS
from tests.fuzz.packing import (
    pack_glb,
    pack_gzip,
    pack_png,
    pack_spz,
    pack_zip,
    unpack_glb,
    unpack_spz,
    unpack_zip,
)
from tests.fuzz.pictures import PICTURES
from tests.fuzz.poses import POSES
from tests.fuzz.reader import Files, Reader, of_file, same
from tests.fuzz.videos import VIDEOS
from tests.io.camera_paths import FRAMES, NERFSTUDIO, path_file
from tests.pictures import picture
from tests.splats.samples import sample
from tests.videos import write_video

PHOTOS = tuple(
    Photo(name=f"p{i}.jpg", path=f"p{i}.jpg", width=64, height=48, digest="") for i in range(4)
)
NAMES = [photo.name for photo in PHOTOS]
SIZES = {photo.name: (photo.width, photo.height) for photo in PHOTOS}


def model(kinds: Sequence[str]) -> Reconstruction:
    """Four images with cameras of these models, and six points."""
    rng = np.random.default_rng(0)
    intrinsics = {"f": 50.0, "fx": 50.0, "fy": 51.0, "cx": 32.0, "cy": 24.0}
    cameras = {
        number: Camera(
            kind, 64, 48, np.array([intrinsics.get(n, 0.01) for n in CAMERA_MODELS[kind][1]])
        )
        for number, kind in enumerate(kinds, 1)
    }
    images = {
        i + 1: PosedImage(name, i % len(kinds) + 1, np.eye(3), rng.normal(size=3))
        for i, name in enumerate(NAMES)
    }
    points = Points(
        rng.normal(size=(6, 3)),
        rng.integers(0, 256, (6, 3), np.uint8),
        rng.random(6),
        np.arange(0, 13, 2),
        np.tile([1, 2, 3], 4)[:12],
        rng.random((12, 2)) * 40,
    )
    return Reconstruction(cameras, images, points)


def colmap_seeds(first: str) -> Callable[[], Sequence[Files]]:
    """Models whose file ``first`` is mutated."""

    def make() -> Sequence[Files]:
        found = []
        for kinds in (["PINHOLE"], ["SIMPLE_RADIAL", "OPENCV_FISHEYE"], ["FULL_OPENCV"]):
            with tempfile.TemporaryDirectory() as folder:
                write_model(Path(folder), model(kinds), text=first.endswith("txt"))
                files = {file.name: file.read_bytes() for file in Path(folder).iterdir()}
            found.append({first: files.pop(first), **files})
        return found

    return make


def read_colmap(folder: Path) -> object:
    by_name = {photo.name: photo for photo in PHOTOS}
    return fit_to_photos(read_model(folder), by_name, str(folder))


def gaussian_seeds(suffix: str, spz_version: int = 3) -> Callable[[], Sequence[Files]]:
    def make() -> Sequence[Files]:
        found = []
        for degree in (3, 1, 0):
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / f"g{suffix}"
                write_gaussians(file, sample(6, degree), spz_version=spz_version)
                found.append({file.name: file.read_bytes()})
        return found

    return make


def ascii_ply() -> Sequence[Files]:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    rows = np.random.default_rng(0).normal(size=(3, len(names)))
    lines = ["ply", "format ascii 1.0", "element vertex 3"]
    lines += [f"property float {name}" for name in names] + ["end_header"]
    lines += [" ".join(f"{value:.3f}" for value in row) for row in rows]
    return [{"g.ply": "\n".join([*lines, ""]).encode()}]


def read_any_gaussians(folder: Path) -> object:
    (file,) = folder.iterdir()
    gaussians = read_gaussians(file, [])
    count = len(gaussians)
    assert count > 0 and gaussians.sh.shape == (count, (gaussians.sh_degree + 1) ** 2, 3)
    assert all(len(t) == count and bool(t.isfinite().all()) for t in gaussians.tensors().values())
    return gaussians


def transforms_seeds() -> Sequence[Files]:
    pose = np.eye(4)
    views = [
        View(n, f"images/{n}", None, 64, 48, 50.0, 50.0, 32.0, 24.0, pose, i == 0)
        for i, n in enumerate(NAMES)
    ]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "transforms.json"
        write_transforms(file, views, Path(folder))
        content: dict[str, Any] = json.loads(file.read_text())
    for i, frame in enumerate(content["frames"]):
        frame["file_path"] = f"images/p{i}.jpg"
    extra = {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 2.0}
    fisheye = content | extra | {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k3": 0.01}
    full = content | {"k1": 0.1, "k2": 0.01, "p1": 1e-3, "k4": 1e-3, "camera_angle_x": 0.7}
    return [{"transforms.json": json.dumps(c).encode()} for c in (content, fisheye, full)]


def llff_seeds() -> Sequence[Files]:
    row = np.zeros((3, 5))
    row[:, :3] = np.eye(3)[:, [1, 0, 2]] * (1, 1, -1)
    row[:, 4] = 48, 64, 50
    rows = np.tile(np.append(row.ravel(), [1.0, 9.0]), (len(NAMES), 1))
    buffer = io.BytesIO()
    np.save(buffer, rows)
    return [{"poses_bounds.npy": buffer.getvalue()}]


def read_llff(folder: Path) -> object:
    (file,) = folder.iterdir()
    read_poses_bounds(file, NAMES)
    return load_given(file, "llff", PHOTOS, NAMES)


def gcp_seeds() -> Sequence[Files]:
    lines = [f"{i}.5 {i} 10 {i} 20 p{i}.jpg point{i}" for i in range(4)]
    return [{"gcp_list.txt": "\n".join(["EPSG:32632", *lines]).encode()}]


def photo_seeds(suffix: str) -> Callable[[], Sequence[Files]]:
    def make() -> Sequence[Files]:
        if suffix == ".heic":
            if not pillow_formats.heif_installed():
                return []
            pillow_formats.register(suffix)
        with tempfile.TemporaryDirectory() as folder:
            tags = {0x010F: "NIKON", 0x0110: "D60", 0x0112: 6}
            exif = {0x920A: 35.0, 0xA405: 52, 0x9003: "2020:01:02 03:04:05", 0xA432: "lens"}
            gps = {1: "N", 2: (50.0, 30.0, 10.0), 3: "E", 4: (8.0, 1.0, 2.0), 6: 100.0}
            alpha = suffix in (".png", ".webp", ".tif")
            first = picture(Path(folder) / f"a{suffix}", (24, 16), tags=tags, exif=exif, gps=gps)
            modes = ["L", "RGBA"] if alpha else ["L"]
            more = [picture(Path(folder) / f"{m}{suffix}", (24, 16), mode=m) for m in modes]
            return [{f"x{suffix}": path.read_bytes()} for path in (first, *more)]

    return make


def read_photo(folder: Path) -> object:
    """Read the facts, then the pixels, as the stages do."""
    (file,) = folder.iterdir()
    facts = read_facts(file)
    assert facts.width > 0 and facts.height > 0 and facts.body.isprintable()
    return read_picture(file)


def exr_seeds() -> Sequence[Files]:
    import OpenEXR

    values = np.random.default_rng(0).random((16, 24)).astype(np.float32)
    found = []
    for names in ("RGB", "RGBA", "Y"):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "x.exr"
            with OpenEXR.File(header, {name: values.copy() for name in names}) as file:
                file.write(str(path))
            found.append({path.name: path.read_bytes()})
    return found


def read_exr(file: Path) -> object:
    """Read the facts, then the pixels, whose ValueError the check of photographs reports."""
    read_facts(file)
    try:
        return exr.read_pixels(io.BytesIO(file.read_bytes()))
    except ValueError as error:
        raise UserError(str(error)) from None


def video_seeds() -> Sequence[Files]:
    frames = list(np.random.default_rng(0).integers(0, 255, (3, 32, 48, 3), np.uint8))
    with tempfile.TemporaryDirectory() as folder:
        paths = [write_video(Path(folder) / name, frames) for name in ("a.avi", "a.mp4")]
        return [{f"x{path.suffix}": path.read_bytes()} for path in paths]


def camera_path_seeds() -> Sequence[Files]:
    contents = (path_file().model_dump(), NERFSTUDIO, FRAMES)
    return [{"path.json": json.dumps(content).encode()} for content in contents]


def depth_seeds() -> Sequence[Files]:
    found = []
    for dtype in ("<f4", "<u2", "<f8"):
        buffer = io.BytesIO()
        np.save(buffer, np.ones((4, 6), dtype))
        found.append({"d.npy": buffer.getvalue()})
    return found


def read_npy(file: Path) -> object:
    try:
        read_array(file.read_bytes())
    except ValueError as error:
        raise UserError(str(error)) from None
    return read_depth(file)


READERS: dict[str, Reader] = {
    **{
        f"colmap-{name}": Reader(colmap_seeds(name), read_colmap)
        for stem in ("cameras", "images", "points3D")
        for name in (f"{stem}.bin", f"{stem}.txt")
    },
    "transforms": Reader(
        transforms_seeds,
        lambda folder: load_given(folder, "transforms", PHOTOS, base_folder="images"),
    ),
    "llff": Reader(llff_seeds, read_llff),
    **POSES,
    **CLOUDS,
    "gcp": Reader(gcp_seeds, lambda folder: read_ground_control(folder / "gcp_list.txt", SIZES)),
    "ply": Reader(gaussian_seeds(".ply"), read_any_gaussians),
    "ply-ascii": Reader(ascii_ply, read_any_gaussians),
    "spz": Reader(gaussian_seeds(".spz"), read_any_gaussians, gzip.decompress, pack_gzip),
    "spz-zstd": Reader(gaussian_seeds(".spz", 4), read_any_gaussians, unpack_spz, pack_spz),
    "sog": Reader(gaussian_seeds(".sog"), read_any_gaussians, unpack_zip, pack_zip),
    "splat": Reader(gaussian_seeds(".splat"), read_any_gaussians),
    "glb": Reader(gaussian_seeds(".glb"), read_any_gaussians, unpack_glb, pack_glb),
    "npz": Reader(gaussian_seeds(".npz"), read_any_gaussians, unpack_zip, pack_zip),
    "camera-path": Reader(camera_path_seeds, of_file(read_camera_path), weight=0.3),
    "npy": Reader(depth_seeds, of_file(read_npy)),
    "jpeg": Reader(photo_seeds(".jpg"), read_photo),
    "png": Reader(photo_seeds(".png"), read_photo, same, pack_png),
    "tiff": Reader(photo_seeds(".tif"), read_photo),
    "webp": Reader(photo_seeds(".webp"), read_photo, weight=0.5),
    "bmp": Reader(photo_seeds(".bmp"), read_photo, weight=0.5),
    "avif": Reader(photo_seeds(".avif"), read_photo, weight=0.2),
    "heic": Reader(photo_seeds(".heic"), read_photo, weight=0.2),
    "exr": Reader(exr_seeds, of_file(read_exr), weight=0.3),
    "video": Reader(video_seeds, of_file(read_video_facts), weight=0.1),
    **GEOREFERENCE,
    **PICTURES,
    **FOLDERS,
    **VIDEOS,
}
