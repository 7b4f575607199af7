"""Undistorted photographs, masks, depth maps and observations equal those of a pinhole camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.config.schema import Undistort, Views
from pipeline.demo.cameras import lens, orbit
from pipeline.demo.render import rays, render
from pipeline.demo.scene import OBJECTS
from pipeline.demo.sensor import srgb, to_bytes
from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import project
from pipeline.io.colmap import read_model
from pipeline.io.recorded import digest_of
from pipeline.photos.lens import pinhole_camera
from pipeline.photos.load import load_mask, load_rgb, load_rgba, resize_area
from pipeline.photos.undistort import undistort
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

SIZE = (160, 120)


def posed(name: str) -> PosedImage:
    return orbit([name] * 8, 0)[0]


def long_lens(distortion: str) -> Camera:
    """A longer lens than the demo's: its image is smooth enough at this size."""
    short = lens(distortion, *SIZE)
    stretch = np.ones(len(short.params))
    stretch[: len(short.intrinsics_names) - 2] = 1.6
    return Camera(short.model, *SIZE, short.params * stretch)


def rendered(camera: Camera, *, transparent: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) colours and (H, W) alpha of the demo scene."""
    seen = render(posed("a"), camera, rays(camera), OBJECTS, transparent=transparent)
    straight = seen.light / np.maximum(seen.coverage, 1e-6)[..., None]
    return to_bytes(srgb(straight)), to_bytes(seen.coverage)


def photo(path: Path, width: int, height: int, **more: object) -> Photo:
    for kind in ("mask", "depth"):
        if kind in more:
            more[f"{kind}_digest"] = digest_of(Path(str(more[kind])))
    size = {"width": width, "height": height}
    return Photo(name=path.name, path=str(path), digest=digest_of(path), **size, **more)  # type: ignore[arg-type]


def scene(camera: Camera, *photos: Photo) -> tuple[Manifest, Reconstruction]:
    images = {i: posed(p.name) for i, p in enumerate(photos, start=1)}
    return Manifest(scene="s", photos=photos), Reconstruction({1: camera}, images)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b.astype(float)) ** 2)))


@pytest.mark.parametrize("distortion", ["simple_radial", "opencv", "opencv_fisheye"])
def test_equals_the_render_of_the_pinhole_camera(tmp_path: Path, distortion: str) -> None:
    camera = long_lens(distortion)
    Image.fromarray(rendered(camera)[0]).save(tmp_path / "a.png")
    manifest, model = scene(camera, photo(tmp_path / "a.png", *SIZE))
    report = undistort(manifest, model, Undistort(), Views(), tmp_path / "out", threads=2)
    target = read_model(tmp_path / "out" / "sparse" / "0").cameras[1]
    made = load_rgb(report.manifest.photos[0].path)
    assert target.model == "PINHOLE" and made.shape[1::-1] == (target.width, target.height)
    assert psnr(made, rendered(target)[0]) >= 35
    assert report.manifest.photos[0].mask is None and not report.warnings


def test_blank_pixels_are_masked(tmp_path: Path) -> None:
    camera = Camera("SIMPLE_RADIAL", *SIZE, np.array([200.0, 80.0, 60.0, -0.25]))
    Image.fromarray(rendered(camera)[0]).save(tmp_path / "a.png")
    manifest, model = scene(camera, photo(tmp_path / "a.png", *SIZE))
    whole_border = Undistort(blank_pixels=1.0)
    report = undistort(manifest, model, whole_border, Views(), tmp_path / "out", threads=1)
    target = read_model(tmp_path / "out" / "sparse" / "0").cameras[1]
    assert target.width > SIZE[0] and target.height > SIZE[1]
    new = report.manifest.photos[0]
    assert new.mask is not None and len(report.warnings) == 1 and "blank" in report.warnings[0]
    mask = load_mask(new.mask)
    assert 0.8 < mask.mean() < 1.0
    assert psnr(load_rgb(new.path)[mask], rendered(target)[0][mask]) >= 35


def test_images_are_downscaled_by_area_with_their_camera(tmp_path: Path) -> None:
    camera = long_lens("opencv")
    Image.fromarray(rendered(camera)[0]).save(tmp_path / "a.png")
    manifest, model = scene(camera, photo(tmp_path / "a.png", *SIZE))
    small = Views(max_long_side_px=100)
    report = undistort(manifest, model, Undistort(), small, tmp_path / "out", threads=1)
    target = read_model(tmp_path / "out" / "sparse" / "0").cameras[1]
    assert max(target.width, target.height) == 100
    full = rendered(pinhole_camera(camera, 0.0))[0]
    expected = resize_area(full, target.width, target.height)
    assert psnr(load_rgb(report.manifest.photos[0].path), expected) >= 35
    np.testing.assert_allclose(target.params[0], camera.params[0] * 100 / full.shape[1])


def test_alpha_masks_and_depth_are_undistorted(tmp_path: Path) -> None:
    camera = long_lens("opencv")
    colour, alpha = rendered(camera, transparent=True)
    depth = render(posed("a"), camera, rays(camera), OBJECTS).depth
    Image.fromarray(np.dstack([colour, alpha])).save(tmp_path / "a.png")
    Image.fromarray((alpha > 127).astype(np.uint8)).save(tmp_path / "mask.png")
    np.save(tmp_path / "depth.npy", depth)
    more = {"mask": str(tmp_path / "mask.png"), "depth": str(tmp_path / "depth.npy")}
    manifest, model = scene(camera, photo(tmp_path / "a.png", *SIZE, alpha=True, **more))
    report = undistort(manifest, model, Undistort(), Views(), tmp_path / "out", threads=1)
    target = read_model(tmp_path / "out" / "sparse" / "0").cameras[1]
    new = report.manifest.photos[0]
    made, made_alpha = load_rgba(new.path)
    true, true_alpha = rendered(target, transparent=True)
    assert made_alpha is not None and psnr(made_alpha, true_alpha) >= 30
    solid = true_alpha == 255
    assert psnr(made[solid], true[solid]) >= 35
    assert new.mask is not None and new.depth is not None
    assert np.mean(load_mask(new.mask) == (true_alpha > 127)) > 0.99
    true_depth = render(posed("a"), target, rays(target), OBJECTS).depth
    assert np.median(np.abs(np.load(new.depth) - true_depth)) < 0.005


def test_observations_are_undistorted_and_unregistered_photographs_are_left_out(
    tmp_path: Path,
) -> None:
    camera = long_lens("opencv")
    colour, _ = rendered(camera)
    for name in ("a.png", "a.jpg", "left.png"):
        Image.fromarray(colour).save(tmp_path / name)
    photos = [photo(tmp_path / name, *SIZE) for name in ("a.jpg", "a.png", "left.png")]
    manifest, model = scene(camera, *photos)
    del model.images[3]
    flat = np.array([[0.05, -0.02], [0.1, 0.12], [-0.2, 0.1]])
    local = np.concatenate([flat, np.ones((3, 1))], axis=1) * 2.0
    pose = posed("a")
    seen = project(camera, flat)
    points = Points(
        xyz=(local - pose.translation) @ pose.rotation,
        rgb=np.zeros((3, 3), np.uint8),
        error=np.zeros(3),
        track_start=np.array([0, 2, 3, 4]),
        track_image_id=np.array([1, 2, 1, 2]),
        track_xy=np.stack([seen[0], [0.2, 0.2], seen[1], seen[2]]),
    )
    model = Reconstruction(model.cameras, model.images, points)
    report = undistort(manifest, model, Undistort(), Views(), tmp_path / "out", threads=2)
    assert [p.name for p in report.manifest.photos] == ["a.jpg.png", "a.png.png"]
    written = read_model(tmp_path / "out" / "sparse" / "0")
    assert sorted(written.by_name()) == ["a.jpg.png", "a.png.png"]
    np.testing.assert_allclose(written.points.xyz, points.xyz)
    fx, fy, cx, cy = written.cameras[1].pinhole
    found = written.points.track_xy
    expected = flat * (fx, fy) + (cx, cy)
    known = np.isfinite(found).all(axis=1)
    assert known.sum() == 3  # the one in the corner is cropped away
    np.testing.assert_allclose(np.sort(found[known], 0), np.sort(expected, 0), atol=1e-6)


def test_files_do_not_depend_on_threads(tmp_path: Path) -> None:
    camera = long_lens("opencv")
    colour, _ = rendered(camera)
    photos = []
    for i in range(4):
        Image.fromarray(np.roll(colour, i, axis=1)).save(tmp_path / f"{i}.png")
        photos.append(photo(tmp_path / f"{i}.png", *SIZE))
    manifest, model = scene(camera, *photos)
    for threads in (1, 4):
        undistort(manifest, model, Undistort(), Views(), tmp_path / str(threads), threads=threads)
    first, second = (
        {p.relative_to(tmp_path / t): p.read_bytes() for p in sorted((tmp_path / t).rglob("*.*"))}
        for t in ("1", "4")
    )
    assert first == second and len(first) > 6


def test_pinhole_images_are_unchanged(tmp_path: Path) -> None:
    camera = Camera("SIMPLE_RADIAL", 40, 20, np.array([50.0, 20.0, 10.0, 0.0]))
    rgb = np.random.default_rng(0).integers(0, 255, (20, 40, 3), np.uint8)
    Image.fromarray(rgb).save(tmp_path / "a.png")
    manifest, model = scene(camera, photo(tmp_path / "a.png", 40, 20))
    report = undistort(manifest, model, Undistort(), Views(), tmp_path / "out", threads=1)
    assert np.array_equal(load_rgb(report.manifest.photos[0].path), rgb)


def test_off_centre_principal_points_are_kept_and_wide_lenses_are_limited() -> None:
    off = Camera("SIMPLE_RADIAL", 200, 150, np.array([160.0, 90.0, 80.0, -0.1]))
    cropped = pinhole_camera(off, 0.0)
    assert cropped.width <= 1.1 * 200 and 0 <= cropped.params[2] - 90 < 10
    wide = Camera("OPENCV_FISHEYE", 640, 480, np.array([200.0, 200, 320, 240, 0, 0, 0, 0]))
    for blank in (0.0, 1.0):
        seen = pinhole_camera(wide, blank)
        assert seen.width <= 2 * 640 and seen.height <= 2 * 480


def test_a_photograph_of_another_aspect_ratio_is_an_error(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((40, 20, 3), np.uint8)).save(tmp_path / "turned.png")
    manifest, model = scene(long_lens("opencv"), photo(tmp_path / "turned.png", 20, 40))
    with pytest.raises(UserError, match=r"turned\.png.*20x40"):
        undistort(manifest, model, Undistort(), Views(), tmp_path / "out", threads=1)
