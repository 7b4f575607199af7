"""Masks that training found in its views, on the pixels of the photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.rays import pixels, rays
from pipeline.photos.encode import write_picture
from pipeline.photos.load import load_mask
from pipeline.photos.naming import rename
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction
from pipeline.scene.views import view_size

Mask = NDArray[np.bool_]

# Masks are found at a fraction of the views' size: so many pixels along a photograph's longer side
# keep all of their detail.
_MAX_SIDE = 2000


@dataclass(frozen=True)
class PosedPhotos:
    """Photographs, or views that were made of them, with their cameras."""

    manifest: Manifest
    model: Reconstruction


@dataclass(frozen=True)
class _View:
    """A view with what was found in it: (H, W) bool at any size, false for what is left out."""

    camera: Camera
    image: PosedImage
    used: Mask


def mask_file(view: str) -> str:
    """The name of the file with what was found in the view of this name."""
    return f"{view}.png"


def write_found(folder: Path, transients: Mapping[str, Mask]) -> None:
    """Write a mask for each view in which transients, (H, W) bool, were found: 255 for pixels that
    are used, 0 for those that are left out, as in masks/."""
    for name, mask in transients.items():
        write_picture(folder / mask_file(name), np.where(mask, 0, 255).astype(np.uint8))


def write_photo_masks(out: Path, found: Path, views: PosedPhotos, photos: PosedPhotos) -> None:
    """Write the masks in the folder ``found`` as masks of the photographs, at their stored size,
    united with the masks that the photographs have. Without any in ``found``, none is written.

    Args:
        views: The undistorted views, or those that wide photographs were split into.
        photos: The photographs, in the same world.
    """
    originals = _originals(views.manifest, photos.manifest)
    posed, sources = views.model.by_name(), photos.model.by_name()
    parts: dict[str, list[_View]] = {}
    for view in views.manifest.photos:
        file = found / mask_file(view.name)
        if file.is_file() and view.name in posed:
            image = posed[view.name]
            shown = _View(views.model.cameras[image.camera_id], image, load_mask(str(file)))
            parts.setdefault(originals[view.name], []).append(shown)
    names = rename({photo.name: ".png" for photo in photos.manifest.photos})
    for photo in photos.manifest.photos:
        used = None if photo.mask is None else load_mask(photo.mask, photo.mask_digest)
        if photo.name in parts:
            image = sources[photo.name]
            seen = _on_photo(photo, photos.model.cameras[image.camera_id], image, parts[photo.name])
            used = seen if used is None else seen & enlarged(used, photo.width, photo.height)
        if parts and used is not None:
            write_picture(out / names[photo.name], used.astype(np.uint8) * 255)


def enlarged(mask: Mask, width: int, height: int) -> Mask:
    """The mask at another size, by nearest neighbour."""
    rows = ((np.arange(height) + 0.5) * (mask.shape[0] / height)).astype(np.intp)
    columns = ((np.arange(width) + 0.5) * (mask.shape[1] / width)).astype(np.intp)
    return mask[rows[:, None], columns]


def _on_photo(photo: Photo, camera: Camera, image: PosedImage, views: Sequence[_View]) -> Mask:
    """(H, W) mask of a photograph: false where a view leaves out what it shows."""
    width, height = view_size(photo.width, photo.height, _MAX_SIDE)
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    directions = rays(camera.resized(width, height), xy)
    used = np.ones((height, width), bool)
    for view in views:
        turn = view.image.rotation @ image.rotation.T
        size = view.used.shape[1], view.used.shape[0]
        local = np.einsum("ij,hwj->hwi", turn, directions)
        place = pixels(view.camera.resized(*size), local)
        inside = ((place >= 0) & (place < size)).all(axis=-1)
        column, row = place[inside].astype(np.intp).T
        used[inside] &= view.used[row, column]
    return enlarged(used, photo.width, photo.height)


def _originals(views: Manifest, photos: Manifest) -> dict[str, str]:
    """The name of the photograph that each view shows: undistorted views differ in the suffix."""
    names = {
        PurePosixPath(photo.name).with_suffix("").as_posix(): photo.name for photo in photos.photos
    }
    names |= {photo.name: photo.name for photo in photos.photos}

    def original(view: Photo) -> str:
        if view.source is not None:
            return view.source
        if view.name in names:
            return view.name
        return names[PurePosixPath(view.name).with_suffix("").as_posix()]

    return {view.name: original(view) for view in views.photos}
