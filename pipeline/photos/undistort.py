"""Undistort images, masks and depth maps to pinhole cameras.

A panorama or a wide fisheye photograph becomes several views (``faces``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from pipeline.config import schema
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import write_model
from pipeline.photos.faces import Face, WideCamera, face_lens, split, used_share
from pipeline.photos.image_circle import image_circle
from pipeline.photos.lens import Lens, pinhole_lens
from pipeline.photos.naming import rename
from pipeline.photos.undistorted_files import Target, load_source, write_view
from pipeline.photos.undistorted_model import Part, undistorted_model
from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import threads_within
from pipeline.runtime.progress import Progress
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import Reconstruction

# The peak memory in bytes per pixel of a photograph: as decoded, as extended beyond its borders,
# and its views. Maps are kept for all photographs of a camera.
_PHOTO_BYTES, _MAP_BYTES = 12.0, 14.0
# The largest relative difference of the aspect ratios of a photograph and its camera, which differ
# by rounding.
SHAPE_TOLERANCE = 0.02

#: The camera's number in the model, and the width and height of photographs in pixels.
Key = tuple[int, int, int]


@dataclass(frozen=True)
class UndistortReport:
    """The result of ``undistort``.

    Attributes:
        manifest: The undistorted photographs, or their views.
        photographs: The number of photographs that were undistorted or split.
        split: The number of photographs that were split into views.
        used_share: The share of the pixels of split photographs, inside the lens's image circle,
            that are in some view; None if none was split.
        decisions, warnings: Sentences for the log.
    """

    manifest: Manifest
    photographs: int
    split: int
    used_share: float | None
    decisions: tuple[str, ...]
    warnings: tuple[str, ...]


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
    outside the image become NaN. The views of a split photograph are ``<stem>_<direction>.png``
    with composed poses; each observation belongs to the view in whose middle it is.

    Raises:
        UserError: A photograph cannot be read, or its aspect ratio differs from its camera's.
    """
    registered = model.by_name()
    photos = [photo for photo in manifest.photos if photo.name in registered]
    groups: dict[Key, list[Photo]] = {}
    for photo in photos:
        key = (registered[photo.name].camera_id, photo.width, photo.height)
        groups.setdefault(key, []).append(photo)
    wide = {key: _wide_camera(model, key[0], group, config) for key, group in groups.items()}
    faces = {key: split(camera) for key, camera in wide.items() if camera is not None}
    names = _names(groups, faces, config)

    progress = Progress("undistorting", len(photos), "photographs")
    cameras: dict[int, Camera] = {}
    shares: dict[Key, float] = {}
    parts: dict[str, list[Part]] = {}
    done: list[Photo] = []
    decisions: list[str] = []
    warnings: list[str] = []
    largest = max((photo.width * photo.height for photo in photos), default=0)
    threads = threads_within(threads, _PHOTO_BYTES * largest, _MAP_BYTES * largest)
    with ThreadPoolExecutor(threads) as pool:
        # One camera is processed at a time: its maps are as large as an image.
        for key, group in sorted(groups.items()):
            camera = wide[key]
            if camera is None:
                source = _camera_of_size(model.cameras[key[0]], group[0])
                lens = pinhole_lens(source, config.blank_pixels, views.max_long_side_px)
                targets = [Target(lens, len(cameras) + 1)]
                warnings += _blank(key[0], source, lens)
            else:
                shares[key] = used_share(camera, faces[key])
                decisions.append(_describe(key[0], camera, faces[key], shares[key]))
                targets = [
                    Target(face_lens(camera, face, views.max_long_side_px), number, face, camera)
                    for number, face in enumerate(faces[key], start=len(cameras) + 1)
                ]
            cameras |= {target.camera_id: target.lens.target for target in targets}
            work = partial(_write_views, targets=targets, names=names, config=config, out=out)
            for photo, new in zip(group, pool.map(work, group), strict=True):
                parts[photo.name] = [
                    Part(view.name, target.camera_id, target.rotation)
                    for view, target in zip(new, targets, strict=True)
                ]
                done += new
                progress.advance()

    write_model(out / "sparse" / "0", undistorted_model(model, cameras, parts))
    undistorted = Manifest(
        scene=manifest.scene,
        photos=tuple(sorted(done, key=lambda photo: photo.name)),
        warnings=manifest.warnings,
    )
    undistorted.write(out / "images.json")
    return UndistortReport(
        manifest=undistorted,
        photographs=len(photos),
        split=sum(len(groups[key]) for key in faces),
        used_share=_mean_share(shares, groups),
        decisions=tuple(decisions),
        warnings=tuple(warnings),
    )


def _mean_share(shares: Mapping[Key, float], groups: Mapping[Key, list[Photo]]) -> float | None:
    """The mean of ``shares`` over the pixels of the photographs; None without any."""
    sizes = {key: len(groups[key]) * key[1] * key[2] for key in shares}
    used = sum(shares[key] * size for key, size in sizes.items())
    return used / sum(sizes.values()) if sizes else None


def _write_views(
    photo: Photo,
    *,
    targets: Sequence[Target],
    names: Mapping[str, str],
    config: schema.Undistort,
    out: Path,
) -> list[Photo]:
    """Write the views of a photograph, and return their entries in the manifest."""
    loaded = load_source(photo, targets[0])
    return [
        write_view(photo, loaded, names[_key(photo, target.face)], target, config, out)
        for target in targets
    ]


def _wide_camera(
    model: Reconstruction, camera_id: int, group: list[Photo], config: schema.Undistort
) -> WideCamera | None:
    """The camera of photographs that are split into views; None if they become one view each."""
    camera = _camera_of_size(model.cameras[camera_id], group[0])
    if camera.is_spherical:
        return WideCamera(camera, nadir=float(np.radians(config.mask_nadir_degrees)))
    if not WideCamera(camera).is_split:
        return None
    found = WideCamera(camera, radius=image_circle(camera, group))
    return found if found.is_split else None


def _names(
    groups: Mapping[Key, list[Photo]], faces: Mapping[Key, list[Face]], config: schema.Undistort
) -> dict[str, str]:
    """The file names of the views, by ``_key``."""
    suffixes = {}
    for key, group in groups.items():
        for photo in group:
            suffix = ".jpg" if config.jpeg_quality > 0 and not photo.alpha else ".png"
            for face in _faces_or_whole(faces.get(key, [])):
                suffixes[_key(photo, face)] = suffix
    return rename(suffixes)


def _faces_or_whole(faces: list[Face]) -> list[Face | None]:
    return [*faces] if faces else [None]


def _key(photo: Photo, face: Face | None) -> str:
    """The name of a view before its suffix is replaced."""
    if face is None:
        return photo.name
    path = PurePosixPath(photo.name)
    return str(path.with_name(f"{path.stem}_{face.name}{path.suffix}"))


def _blank(camera_id: int, camera: Camera, lens: Lens) -> list[str]:
    """A warning if a part of the undistorted images is blank."""
    if lens.valid is None:
        return []
    share = 100 * (1 - float(lens.valid.mean()))
    return [
        f"camera {camera_id} ({camera.model}): {share:.1f}% of the undistorted images is blank and "
        "masked"
    ]


def _describe(camera_id: int, wide: WideCamera, faces: list[Face], share: float) -> str:
    across, high = wide.field_degrees()
    circle = "" if np.isinf(wide.radius) else f", image circle of {wide.radius:.0f} px"
    names = ", ".join(face.name for face in faces)
    return (
        f"camera {camera_id} ({wide.camera.model}, {across:.0f} x {high:.0f} degrees{circle}): "
        f"{len(faces)} views of each photograph ({names}) show {share:.1%} of "
        "its pixels"
    )


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
