"""The pinhole views that training and evaluation look at."""

from __future__ import annotations

import posixpath
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.config import schema
from pipeline.geometry.up_direction import up_direction
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction


@dataclass(frozen=True)
class View:
    """A pinhole view ready for training or evaluation.

    Attributes:
        name: the photograph's name.
        image, mask: files; the mask's non-zero pixels count; None where there is none.
        width, height: pixels of the target resolution (the file may be larger).
        fx, fy, cx, cy: pixels, at the target resolution.
        world_to_camera: (4, 4) float64.
        is_test: held out.
        camera_id: key into ``Reconstruction.cameras``; views of one camera share its lens.
        image_digest, mask_digest: of the files (``recorded.digest_of``); readers compare them.
    """

    name: str
    image: str
    mask: str | None
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: NDArray[np.float64]
    is_test: bool
    camera_id: int = 0
    image_digest: str | None = None
    mask_digest: str | None = None

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) the camera's centre in the world."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]


def is_held_out(index: int, every: int) -> bool:
    """The field's split (Mip-NeRF360): of the views sorted by name, each ``every``-th from the
    first is held out; 0 holds out none."""
    return every > 0 and index % every == 0


def view_size(width: int, height: int, max_long_side: int) -> tuple[int, int]:
    """Width and height in pixels, reduced so that neither exceeds ``max_long_side``; the shape
    stays, but for rounding."""
    longest = max(width, height)
    if longest <= max_long_side:
        return width, height
    return (
        max(1, round(width * max_long_side / longest)),
        max(1, round(height * max_long_side / longest)),
    )


def load_views(
    manifest: Manifest, model: Reconstruction, views: schema.Views, split: schema.Split
) -> list[View]:
    """The photographs that have a pose, sorted by name, at the size ``views`` asks for.

    Intrinsics are scaled by the exact ratios of widths and of heights.

    Raises:
        ValueError: a camera distorts; such pictures must be undistorted first.
    """
    posed = model.by_name()
    photos = sorted((p for p in manifest.photos if p.name in posed), key=lambda photo: photo.name)
    # A single view is trained on: there is nothing to learn from none.
    every = split.holdout_every if len(photos) > 1 else 0
    result = []
    for index, photo in enumerate(photos):
        image = posed[photo.name]
        camera = model.cameras[image.camera_id]
        if not camera.is_pinhole:
            raise ValueError(f"{photo.name}: its {camera.model} camera distorts")
        width, height = view_size(photo.width, photo.height, views.max_long_side_px)
        fx, fy, cx, cy = camera.resized(width, height).pinhole
        result.append(
            View(
                name=photo.name,
                image=photo.path,
                mask=photo.mask if views.masks == "auto" else None,
                width=width,
                height=height,
                fx=fx,
                fy=fy,
                cx=cx,
                cy=cy,
                world_to_camera=image.world_to_camera,
                is_test=is_held_out(index, every),
                camera_id=image.camera_id,
                image_digest=photo.digest,
                mask_digest=photo.mask_digest if views.masks == "auto" else None,
            )
        )
    return result


def scene_extent(views: list[View]) -> float:
    """1.1 times the largest distance of a training camera from their mean, in world units.

    3DGS's measure of a scene's size (Kerbl et al. 2023, reference code), by which learning rates
    and thresholds scale. Where the training cameras stand in one place all views count, and
    where these do too the extent is 1.
    """
    for chosen in ([view for view in views if not view.is_test], views):
        if chosen:
            centres = np.stack([view.centre for view in chosen])
            radius = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
            # What is left of a distance by the rounding of poses is none.
            if radius > 1e-9 * float(np.abs(centres).max()):
                return 1.1 * radius
    return 1.0


def scene_up(views: Sequence[View], manifest: Manifest) -> NDArray[np.float64]:
    """(3,) ``up_direction`` of these views' cameras as their photographs were held."""
    orientation = {photo.name: photo.orientation for photo in manifest.photos}
    rotations = np.stack([view.world_to_camera[:3, :3] for view in views])
    return up_direction(rotations, [orientation[view.name] for view in views])


def camera_views(model: Reconstruction, max_long_side: int | None) -> list[View]:
    """The model's images as views without photographs, sorted by name, lens distortion left out;
    a folder that they all lie in is left out of their names.

    Args:
        max_long_side: pixels; larger views are reduced to it.
    """
    folders = {posixpath.dirname(image.name) for image in model.images.values()}
    mixed = len({posixpath.isabs(folder) for folder in folders}) != 1
    shared = "" if mixed else posixpath.commonpath(folders)
    views = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        camera = model.cameras[image.camera_id]
        width, height = view_size(camera.width, camera.height, max_long_side or 2**31)
        fx, fy, cx, cy = camera.resized(width, height).pinhole
        pose = image.world_to_camera
        name = image.name[len(shared) :].lstrip("/")
        views.append(View(name, "", None, width, height, fx, fy, cx, cy, pose, False))
    return views


def reduced_size(view: View, factor: int) -> tuple[int, int]:
    """(width, height) of a view at 1 / ``factor``, rounded."""
    return max(1, round(view.width / factor)), max(1, round(view.height / factor))
