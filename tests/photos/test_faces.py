"""Wide photographs are split into pinhole views that hold all of their rays."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.config.schema import Undistort, Views
from pipeline.demo.cameras import FISHEYE_HALF_ANGLE, lens, orbit
from pipeline.demo.render import rays as demo_rays
from pipeline.demo.render import render
from pipeline.demo.scene import OBJECTS
from pipeline.demo.sensor import srgb, to_bytes
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rays import pixels
from pipeline.io.colmap import read_model
from pipeline.io.recorded import digest_of
from pipeline.photos.faces import WideCamera, padded, split, used_share
from pipeline.photos.image_circle import image_circle
from pipeline.photos.load import load_mask, load_rgb
from pipeline.photos.undistort import UndistortReport, undistort
from pipeline.runtime import machine
from pipeline.runtime.isolate import run_isolated
from pipeline.runtime.memory import peak_memory_mb
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import Points, Reconstruction

PANORAMA = lens("equirectangular", 256, 128)


def fisheye(width: int, height: int, degrees: float) -> Camera:
    """An equidistant lens with ``degrees`` along the width."""
    focal = width / np.radians(degrees)
    params = np.array([focal, focal, width / 2, height / 2, 0.0, 0.0, 0.0, 0.0])
    return Camera("OPENCV_FISHEYE", width, height, params)


def rendered(camera: Camera, wide: bool, number: int = 0) -> np.ndarray:
    posed = orbit(["a"] * 8, 0)[number]
    limit = np.pi if camera.is_spherical else FISHEYE_HALF_ANGLE
    seen = render(posed, camera, demo_rays(camera, wide, float(limit)), OBJECTS)
    return to_bytes(srgb(seen.light))


def photo(path: Path, picture: np.ndarray, **more: object) -> Photo:
    Image.fromarray(picture).save(path)
    height, width = picture.shape[:2]
    size = {"width": width, "height": height}
    return Photo(name=path.name, path=str(path), digest=digest_of(path), **size, **more)  # type: ignore[arg-type]


def undistorted(
    folder: Path,
    camera: Camera,
    photos: list[Photo],
    config: Undistort | None = None,
    threads: int = 2,
) -> tuple[UndistortReport, Reconstruction]:
    images = {
        i + 1: image for i, image in enumerate(orbit([p.name for p in photos] + ["x"] * 8, 0))
    }
    images = {i: image for i, image in images.items() if image.name != "x"}
    manifest = Manifest(scene="s", photos=tuple(photos))
    model = Reconstruction({1: camera}, images)
    out = folder / "out"
    report = undistort(manifest, model, config or Undistort(), Views(), out, threads=threads)
    return report, read_model(out / "sparse" / "0")


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b.astype(float)) ** 2)))


@pytest.mark.parametrize(
    "camera, radius, count",
    [
        (PANORAMA, np.inf, 6),
        (lens("fisheye_190", 300, 300), 144, 5),
        (lens("fisheye_190", 400, 300), 144, 5),
        (fisheye(400, 225, 140), np.inf, 3),
        (fisheye(300, 300, 115), np.inf, 5),
        (fisheye(600, 600, 300), 300, 6),
    ],
)
def test_every_ray_that_the_lens_sees_is_in_some_view(
    camera: Camera, radius: float, count: int
) -> None:
    wide = WideCamera(camera, radius)
    assert wide.is_split
    faces = split(wide)
    assert len(faces) == count and used_share(wide, faces) > 0.998
    for face in faces:
        assert min(face.camera.width, face.camera.height) > 0.2 * camera.pinhole[0]


def test_rays_outside_the_image_circle_need_no_view() -> None:
    camera = lens("fisheye_190", 400, 300)
    whole, circle = WideCamera(camera), WideCamera(camera, radius=100.0)
    sizes = [sum(f.camera.width * f.camera.height for f in split(w)) for w in (whole, circle)]
    assert sizes[1] < sizes[0] and used_share(circle, split(circle)) == 1.0


@pytest.mark.parametrize("degrees, is_split", [(80, False), (109, False), (112, True), (190, True)])
def test_fisheye_lenses_are_split_above_110_degrees(degrees: float, is_split: bool) -> None:
    assert WideCamera(fisheye(400, 300, degrees)).is_split == is_split
    assert not WideCamera(Camera("PINHOLE", 400, 300, np.array([50.0, 50, 200, 150]))).is_split


def test_views_keep_the_angular_resolution_of_the_centre() -> None:
    for face in split(WideCamera(PANORAMA)):
        assert face.camera.params[0] == pytest.approx(256 / (2 * np.pi))


@pytest.mark.parametrize(
    "camera", [lens("equirectangular", 384, 192), lens("fisheye_190", 300, 300)]
)
def test_views_equal_renders_of_their_pinhole_cameras(tmp_path: Path, camera: Camera) -> None:
    picture = rendered(camera, wide=True)
    report, model = undistorted(tmp_path, camera, [photo(tmp_path / "a.png", picture)])
    assert report.split == 1 and report.used_share is not None and report.used_share > 0.99
    by_name = model.by_name()
    for view in report.manifest.photos:
        posed = by_name[view.name]
        pinhole = model.cameras[posed.camera_id]
        expected = to_bytes(srgb(render(posed, pinhole, demo_rays(pinhole), OBJECTS).light))
        made = load_rgb(view.path)
        mask = np.ones(made.shape[:2], bool) if view.mask is None else load_mask(view.mask)
        assert view.source == "a.png" and mask.mean() > 0.2
        # Views are sharper than the photograph at their borders.
        assert psnr(made[mask], expected[mask]) > 25, view.name


def test_a_panorama_is_continuous_across_its_borders_and_poles() -> None:
    x, y = np.meshgrid(np.arange(16), np.arange(8))
    picture = (16 * y + x).astype(np.float32)
    wide = padded(picture)
    assert wide.shape == (16, 24)
    assert wide[4, 3] == picture[0, 15] and wide[4, 20] == picture[0, 0]
    assert wide[3, 4] == picture[0, 8] and wide[12, 4] == picture[7, 8]
    np.testing.assert_array_equal(wide[4:12, 4:20], picture)


def test_masks_and_the_nadir_are_split(tmp_path: Path) -> None:
    picture = np.full((128, 256, 3), 90, np.uint8)
    hidden = np.full((128, 256), 255, np.uint8)
    hidden[:, :64] = 0  # the rear left quarter
    Image.fromarray(hidden).save(tmp_path / "m.png")
    more = {"mask": str(tmp_path / "m.png"), "mask_digest": digest_of(tmp_path / "m.png")}
    config = Undistort(mask_nadir_degrees=20)
    report, _ = undistorted(
        tmp_path, PANORAMA, [photo(tmp_path / "a.png", picture, **more)], config
    )
    masks = {view.name: load_mask(str(view.mask)) for view in report.manifest.photos}
    assert masks["a_front.png"].mean() == 1.0
    assert 0.4 < masks["a_left.png"].mean() < 0.6 and 0.4 < masks["a_back.png"].mean() < 0.6
    down = masks["a_down.png"]
    middle = down.shape[0] // 2
    assert not down[middle - 8 : middle + 8, middle - 8 : middle + 8].any() and down.mean() > 0.4


def test_depth_maps_of_panoramas_are_distances(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", np.full((128, 256), 2.0, np.float32))
    more = {"depth": str(tmp_path / "d.npy"), "depth_digest": digest_of(tmp_path / "d.npy")}
    picture = np.full((128, 256, 3), 90, np.uint8)
    report, _ = undistorted(tmp_path, PANORAMA, [photo(tmp_path / "a.png", picture, **more)])
    for view in report.manifest.photos:
        depth = np.load(str(view.depth))
        assert depth.max() == pytest.approx(2.0, abs=0.01)
        assert depth.min() == pytest.approx(2 / np.sqrt(1 + 2 * 1.0913**2), abs=0.02)


def test_observations_move_to_the_views_that_show_them(tmp_path: Path) -> None:
    picture = np.zeros((128, 256, 3), np.uint8)
    photos = [photo(tmp_path / f"{i}.png", picture) for i in range(2)]
    images = {i + 1: image for i, image in enumerate(orbit([p.name for p in photos], 0))}
    xyz = np.random.default_rng(0).uniform(-3, 3, (40, 3))
    xy = [pixels(PANORAMA, xyz @ im.rotation.T + im.translation) for im in images.values()]
    points = Points(
        xyz,
        np.zeros((40, 3), np.uint8),
        np.zeros(40),
        np.arange(0, 81, 2),
        np.tile([1, 2], 40),
        np.stack(xy, axis=1).reshape(-1, 2),
    )
    out = tmp_path / "out"
    model = Reconstruction({1: PANORAMA}, images, points)
    manifest = Manifest(scene="s", photos=tuple(photos))
    undistort(manifest, model, Undistort(), Views(), out, threads=1)
    moved = read_model(out / "sparse" / "0")
    assert len(moved.images) == 12 and len(moved.points) == 40
    owner = np.repeat(np.arange(40), moved.points.track_length)
    for point, number, found in zip(
        owner, moved.points.track_image_id, moved.points.track_xy, strict=True
    ):
        image = moved.images[int(number)]
        local = image.rotation @ moved.points.xyz[point] + image.translation
        expected = pixels(moved.cameras[image.camera_id], local)
        np.testing.assert_allclose(found, expected, atol=0.02)


def test_the_image_circle_is_found_where_the_lens_does_not_fill_the_sensor(tmp_path: Path) -> None:
    camera = lens("fisheye_190", 240, 200)
    photos = [photo(tmp_path / f"{i}.png", rendered(camera, True, i)) for i in range(2)]
    assert image_circle(camera, photos) == pytest.approx(0.48 * 200, rel=0.03)
    full = [photo(tmp_path / "full.png", np.full((200, 240, 3), 120, np.uint8))]
    dark = [photo(tmp_path / "dark.png", np.full((200, 240, 3), 5, np.uint8))]
    assert image_circle(camera, full) == image_circle(camera, dark) == np.inf
    report, _ = undistorted(tmp_path, camera, photos)
    assert report.used_share == 1.0 and report.photographs == 2
    # Nothing outside of the circle is trained on.
    for view in report.manifest.photos:
        if view.mask is not None:
            assert (load_rgb(view.path)[load_mask(view.mask)].max(axis=1) > 8).mean() > 0.999


def test_views_never_take_the_name_of_another_photograph(tmp_path: Path) -> None:
    picture = np.zeros((128, 256, 3), np.uint8)
    photos = [photo(tmp_path / name, picture) for name in ("a.png", "a.jpg")]
    report, _ = undistorted(tmp_path, PANORAMA, photos)
    assert len({view.path for view in report.manifest.photos}) == 12


def peak_growth(folder: Path, threads: int, usable: float) -> float:
    """Bytes per pixel of a panorama that splitting four of them takes at most, with ``threads`` and
    this usable memory."""
    size = (3000, 1500)
    camera = Camera("EQUIRECTANGULAR", *size, np.array(size, np.float64))
    grey = np.tile(np.linspace(0, 255, size[0]).astype(np.uint8)[None, :, None], (size[1], 1, 3))
    photos = [photo(folder / f"p{i}.jpg", grey) for i in range(4)]
    machine.usable_memory = lambda root=Path("/"): int(usable)
    cv2.remap(grey, *np.zeros((2, 8, 8), np.float32), cv2.INTER_LINEAR)  # loads what it needs
    before = peak_memory_mb()
    undistorted(folder, camera, photos, threads=threads)
    return (peak_memory_mb() - before) * 2**20 / (size[0] * size[1])


def test_memory_limits_how_many_panoramas_are_split_at_a_time(tmp_path: Path) -> None:
    """Without the limit, four at a time take twice as much."""
    assert run_isolated(peak_growth, tmp_path, 4, 0.0) < 40
