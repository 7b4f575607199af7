"""Undistort images, masks and depth maps to pinhole cameras."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.config import schema
from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import fold_radius, project, unproject
from pipeline.io.colmap import write_model
from pipeline.io.recorded import digest_of
from pipeline.photos.load import (
    Picture,
    load_mask,
    load_rgb,
    load_rgba,
    read_depth,
    resize_area,
    resize_mask,
    resize_rgba,
    to_8bit,
)
from pipeline.photos.naming import rename
from pipeline.runtime.errors import UserError
from pipeline.runtime.progress import Progress
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.views import view_size

# Number of rows of the undistortion map that are computed at a time.
BATCH_ROWS = 256
# Largest relative difference of the aspect ratio between a photograph and its camera, which
# differ by rounding.
SHAPE_TOLERANCE = 0.02
# COLMAP's limits of the undistorted size relative to the size without distortion: the border of a
# wide lens may be at infinity.
MIN_SCALE, MAX_SCALE = 0.2, 2.0


@dataclass(frozen=True)
class UndistortReport:
    """The manifest of the undistorted photographs, and warnings."""

    manifest: Manifest
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Lens:
    """Undistortion map of one camera.

    Attributes:
        target: the pinhole camera at the size that is written.
        x, y: (height, width) float32 positions in the distorted image, in cv2's pixel coordinates;
            None for a camera without distortion.
        valid: (height, width) bool, False for pixels outside the distorted image; None if all are
            inside.
    """

    target: Camera
    x: NDArray[np.float32] | None
    y: NDArray[np.float32] | None
    valid: NDArray[np.bool_] | None

    def remap(self, picture: Picture, interpolation: int, border: int) -> Picture:
        """Undistort an image at full resolution."""
        if self.x is None or self.y is None:
            return picture
        return np.asarray(cv2.remap(picture, self.x, self.y, interpolation, borderMode=border))


def undistort(
    manifest: Manifest,
    model: Reconstruction,
    config: schema.Undistort,
    views: schema.Views,
    out: Path,
    *,
    threads: int,
) -> UndistortReport:
    """Undistort every registered photograph at full resolution, then downscale it by area.

    Writes ``out/images/<stem>.png`` (.jpg for photographs without alpha if ``jpeg_quality`` is
    set), ``out/masks/`` for masks and blank pixels, ``out/depths/``, ``out/images.json`` and
    ``out/sparse/0``: poses and points are unchanged, observations are undistorted, and those
    outside the image become NaN.

    Raises:
        UserError: a photograph cannot be read, or its aspect ratio differs from its camera's.
    """
    registered = model.by_name()
    photos = [photo for photo in manifest.photos if photo.name in registered]
    jpeg = config.jpeg_quality > 0
    names = rename({p.name: ".jpg" if jpeg and not p.alpha else ".png" for p in photos})
    groups: dict[tuple[int, int, int], list[Photo]] = {}
    for photo in photos:
        key = (registered[photo.name].camera_id, photo.width, photo.height)
        groups.setdefault(key, []).append(photo)

    progress = Progress("undistorting", len(photos), "photographs")
    cameras: dict[int, Camera] = {}
    camera_of: dict[str, int] = {}
    done: list[Photo] = []
    warnings: list[str] = []
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        # One camera at a time: its maps are as large as an image.
        for number, (key, group) in enumerate(sorted(groups.items()), start=1):
            source = _camera_of_size(model.cameras[key[0]], group[0])
            lens = _lens(source, config.blank_pixels, views.max_long_side_px)
            cameras[number] = lens.target
            if lens.valid is not None:
                share = 100 * (1 - float(lens.valid.mean()))
                warnings.append(
                    f"camera {key[0]} ({source.model}): {share:.1f}% of the undistorted images "
                    f"is blank and masked"
                )

            def work(photo: Photo, lens: _Lens = lens) -> Photo:
                return _write(photo, names[photo.name], lens, config, out)

            for photo, new in zip(group, pool.map(work, group), strict=True):
                camera_of[photo.name] = number
                done.append(new)
                progress.advance()

    write_model(out / "sparse" / "0", _undistorted_model(model, cameras, camera_of, names))
    undistorted = Manifest(
        scene=manifest.scene,
        photos=tuple(sorted(done, key=lambda photo: photo.name)),
        warnings=manifest.warnings,
    )
    undistorted.write(out / "images.json")
    return UndistortReport(undistorted, tuple(warnings))


def pinhole_camera(camera: Camera, blank_pixels: float) -> Camera:
    """The PINHOLE camera of the undistorted images of ``camera``, with its focal lengths.

    Args:
        blank_pixels: 0 crops to the rectangle inside the undistorted image border, 1 contains the
            whole border; values between interpolate. As COLMAP's undistorter, except that each side
            is cropped by itself around the principal point.
    """
    fx, fy, cx, cy = camera.pinhole
    width, height = float(camera.width), float(camera.height)
    x, y = np.arange(width + 1), np.arange(height + 1)
    sides = (
        (np.stack([np.zeros_like(y), y], -1), 0, -fx, cx),
        (np.stack([np.full_like(y, width), y], -1), 0, fx, width - cx),
        (np.stack([x, np.zeros_like(x)], -1), 1, -fy, cy),
        (np.stack([x, np.full_like(x, height)], -1), 1, fy, height - cy),
    )
    extents = []  # pixels from the principal point to the left, right, top and bottom
    for border, axis, focal, distorted in sides:
        undistorted = unproject(camera, border)[:, axis] * focal
        finite = undistorted[np.isfinite(undistorted)]
        inner = finite.min(initial=np.inf)
        outer = finite.max(initial=-np.inf) if len(finite) == len(undistorted) else np.inf
        inner, outer = np.clip((inner, outer), MIN_SCALE * distorted, MAX_SCALE * distorted)
        extents.append(outer * blank_pixels + inner * (1 - blank_pixels))
    left, right, top, bottom = extents
    x0, x1 = int(np.ceil(cx - left - 1e-6)), int(np.floor(cx + right + 1e-6))
    y0, y1 = int(np.ceil(cy - top - 1e-6)), int(np.floor(cy + bottom + 1e-6))
    params = np.array([fx, fy, cx - x0, cy - y0])
    return Camera("PINHOLE", max(x1 - x0, 1), max(y1 - y0, 1), params)


def _camera_of_size(camera: Camera, photo: Photo) -> Camera:
    """The camera rescaled to the photograph's size: known poses may refer to larger images."""
    ratio = photo.width * camera.height / (photo.height * camera.width)
    if abs(ratio - 1) > SHAPE_TOLERANCE:
        raise UserError(
            f"is {photo.width}x{photo.height} pixels, its camera {camera.width}x{camera.height}",
            file=photo.path,
            fix="Use the photographs that the poses belong to, neither rotated nor cropped.",
        )
    if (photo.width, photo.height) == (camera.width, camera.height):
        return camera
    return camera.resized(photo.width, photo.height)


def _lens(source: Camera, blank_pixels: float, max_long_side: int) -> _Lens:
    """Undistortion map of ``source``, to an image of at most ``max_long_side`` pixels."""
    if source.is_pinhole:
        size = (source.width, source.height)
        fx, fy, cx, cy = source.pinhole
        same = Camera("PINHOLE", *size, np.array([fx, fy, cx, cy]))
        return _Lens(same.resized(*view_size(*size, max_long_side)), None, None, None)
    pinhole = pinhole_camera(source, blank_pixels)
    size = (pinhole.width, pinhole.height)
    fx, fy, cx, cy = pinhole.pinhole
    map_x, map_y = np.empty((2, size[1], size[0]), np.float32)
    valid = np.empty((size[1], size[0]), bool)
    fold = fold_radius(source)
    columns = (np.arange(size[0]) + 0.5 - cx) / fx
    for start in range(0, size[1], BATCH_ROWS):
        part = slice(start, min(start + BATCH_ROWS, size[1]))
        rows = (np.arange(part.start, part.stop) + 0.5 - cy) / fy
        points = np.stack(np.meshgrid(columns, rows), axis=-1)
        xy = project(source, points)
        inside = (xy >= 0) & (xy <= (source.width, source.height))
        valid[part] = inside.all(axis=-1) & (np.hypot(*np.moveaxis(points, -1, 0)) < fold)
        map_x[part], map_y[part] = xy[..., 0] - 0.5, xy[..., 1] - 0.5
    target = pinhole.resized(*view_size(*size, max_long_side))
    return _Lens(target, map_x, map_y, None if valid.all() else valid)


def _write(
    photo: Photo,
    name: str,
    lens: _Lens,
    config: schema.Undistort,
    out: Path,
) -> Photo:
    """Write one photograph with its mask and depth map; returns its new entry in the manifest."""
    width, height = lens.target.width, lens.target.height
    picture, alpha = _picture(photo, lens)
    path = out / "images" / name
    if path.suffix == ".jpg":
        _encode(path, _bgr(to_8bit(picture)), [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality])
    elif alpha is None:
        _encode(path, _bgr(picture))
    else:
        _encode(path, np.dstack([_bgr(picture), alpha]))

    mask = _mask(photo, lens)
    mask_path = out / "masks" / f"{name}.png" if mask is not None else None
    if mask is not None and mask_path is not None:
        _encode(mask_path, mask.astype(np.uint8) * 255)
    depth_path = None
    if photo.depth is not None:
        suffix = Path(photo.depth).suffix.replace(".npz", ".npy")
        depth_path = out / "depths" / f"{name}{suffix}"
        _write_depth(photo, lens, depth_path)
    return photo.model_copy(
        update={
            "name": name,
            "path": str(path),
            "width": width,
            "height": height,
            "digest": digest_of(path),
            "alpha": alpha is not None,
            "bits": 8 if path.suffix == ".jpg" or picture.dtype == np.uint8 else 16,
            "mask": None if mask_path is None else str(mask_path),
            "mask_digest": None if mask_path is None else digest_of(mask_path),
            "depth": None if depth_path is None else str(depth_path),
            "depth_digest": None if depth_path is None else digest_of(depth_path),
            "focal_px": float(lens.target.params[0]),
        }
    )


def _picture(photo: Photo, lens: _Lens) -> tuple[Picture, NDArray[np.uint8] | None]:
    """Undistorted and downscaled (H, W, 3) colours, uint8 or uint16, and (H, W) alpha."""
    size = (lens.target.width, lens.target.height)
    alpha: NDArray[np.uint8] | None = None
    if photo.alpha:
        picture, alpha = load_rgba(photo.path, photo.digest)
    else:
        picture = load_rgb(photo.path, photo.digest)
    _check_size(picture, photo, photo.path)
    if lens.x is None or alpha is None:
        new = lens.remap(picture, cv2.INTER_CUBIC, cv2.BORDER_REPLICATE)
        new_alpha = alpha
    else:
        # Colours are weighted by alpha: transparent pixels have no influence.
        weight = alpha.astype(np.float32)
        new_weight = lens.remap(weight, cv2.INTER_LINEAR, cv2.BORDER_CONSTANT)
        weighted = lens.remap(picture * weight[..., None], cv2.INTER_LINEAR, cv2.BORDER_CONSTANT)
        colour = weighted / np.maximum(new_weight, 1e-6)[..., None]
        new = np.rint(colour.clip(0, 255)).astype(np.uint8)
        new_alpha = np.rint(new_weight).astype(np.uint8)
    if lens.valid is not None:
        new = new * lens.valid[..., None]
        new_alpha = None if new_alpha is None else new_alpha * lens.valid
    if new_alpha is None:
        return resize_area(new, *size), None
    return resize_rgba(new, new_alpha, *size)


def _mask(photo: Photo, lens: _Lens) -> NDArray[np.bool_] | None:
    """(H, W) mask of the undistorted image, True for valid pixels; None if all are valid."""
    size = (lens.target.width, lens.target.height)
    mask = None
    if photo.mask is not None:
        full = load_mask(photo.mask, photo.mask_digest).astype(np.uint8)
        full = _nearest(full, photo.width, photo.height)
        new = lens.remap(full, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
        mask = resize_mask(new > 0, *size)
    if lens.valid is not None:
        # Partly blank pixels have a wrong colour.
        valid = resize_area(lens.valid.astype(np.float32), *size) > 0.999
        mask = valid if mask is None else mask & valid
    return None if mask is None else np.asarray(mask)


def _write_depth(photo: Photo, lens: _Lens, path: Path) -> None:
    """Write the undistorted depth map, by nearest neighbour. Undistortion does not change depth
    along z."""
    assert photo.depth is not None
    depth = read_depth(photo.depth, photo.depth_digest)
    depth = _nearest(depth, photo.width, photo.height)
    depth = lens.remap(depth, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
    depth = _nearest(depth, lens.target.width, lens.target.height)
    if path.suffix != ".npy":
        return _encode(path, depth)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, depth)


def _nearest(picture: Picture, width: int, height: int) -> Picture:
    if picture.shape[:2] == (height, width):
        return picture
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_NEAREST_EXACT))


def _bgr(rgb: Picture) -> Picture:
    """Convert by cv2: its encoders are several times slower for a reversed view of an array."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def _encode(path: Path, picture: Picture, options: list[int] | None = None) -> None:
    """Encode and write separately: cv2.imwrite does not report a full disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _, data = cv2.imencode(path.suffix, picture, options or [])
    path.write_bytes(data.tobytes())


def _check_size(picture: Picture, photo: Photo, path: str) -> None:
    if picture.shape[1::-1] != (photo.width, photo.height):
        raise UserError(
            f"is {picture.shape[1]}x{picture.shape[0]} pixels, "
            f"was {photo.width}x{photo.height} when the scene was inspected",
            file=path,
            fix="Do not change photographs while the program runs; start it again.",
        )


def _undistorted_model(
    model: Reconstruction,
    cameras: dict[int, Camera],
    camera_of: dict[str, int],
    names: dict[str, str],
) -> Reconstruction:
    """The model with pinhole cameras, new names and undistorted observations."""
    images = {
        number: PosedImage(names[i.name], camera_of[i.name], i.rotation, i.translation)
        for number, i in model.images.items()
        if i.name in names
    }
    points = model.points
    registered = np.isin(points.track_image_id, list(images))
    owner = np.repeat(np.arange(len(points)), points.track_length)[registered]
    ids, xy = points.track_image_id[registered], points.track_xy[registered].copy()
    order = np.argsort(ids, kind="stable")
    for number, image in images.items():
        own = order[slice(*np.searchsorted(ids, [number, number + 1], sorter=order))]
        target = cameras[image.camera_id]
        new = project(target, unproject(model.cameras[model.images[number].camera_id], xy[own]))
        outside = np.any(~((new >= 0) & (new <= (target.width, target.height))), axis=1)
        new[outside] = np.nan
        xy[own] = new
    starts = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=len(points)))])
    undistorted = Points(points.xyz, points.rgb, points.error, starts.astype(np.int64), ids, xy)
    return Reconstruction(cameras, images, undistorted)
