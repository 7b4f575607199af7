"""Views: pinhole cameras with their photographs, for training and evaluation."""

from __future__ import annotations

import posixpath
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.config import schema
from pipeline.geometry.up_direction import up_direction
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction

T = TypeVar("T")


@dataclass(frozen=True)
class Crop:
    """The part of an image that a view shows, pixels of the whole image at the view's scale.

    Attributes:
        left, top: The upper left corner of the part.
        full_width, full_height: The size of the whole image.
    """

    left: int
    top: int
    full_width: int
    full_height: int


@dataclass(frozen=True)
class View:
    """A pinhole camera with its photograph.

    Attributes:
        name: The photograph's name.
        image: The file of the photograph.
        mask: The file of its mask (pixels with value 0 are ignored), or None.
        width, height: The size of the view in pixels (the file may be larger).
        fx, fy, cx, cy: The intrinsics in pixels at that size.
        world_to_camera: (4, 4) float64.
        is_test: Whether this is a test view, which is not trained on.
        camera_id: The key into ``Reconstruction.cameras``; views of one camera share intrinsics.
        has_listed_split: Whether the scene's own split, or the choice of ``split.train_views``,
            says if this is a test view.
        image_digest, mask_digest: The digests of the files, checked when they are read; None: no
            check.
        source: The name of the photograph of which this is a part; None for a whole photograph.
        crop: The part of the image that the view shows; None: all of it.
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
    has_listed_split: bool = False
    source: str | None = None
    crop: Crop | None = None

    def __repr__(self) -> str:
        kind = "test view" if self.is_test else "training view"
        return f"View({self.name!r}: {self.width}x{self.height} pixels, {kind})"

    def cropped(self, left: int, top: int, width: int, height: int) -> View:
        """The part of this view with its upper left corner at pixel (``left``, ``top``)."""
        return replace(
            self,
            width=width,
            height=height,
            cx=self.cx - left,
            cy=self.cy - top,
            crop=Crop(left, top, self.width, self.height),
        )

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) the camera's centre in the world."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]


def is_test_view(index: int, every: int) -> bool:
    """Whether photograph ``index`` of the photographs sorted by name is for testing: every
    ``every``-th is, from the first, as in Mip-NeRF 360 and 3DGS. 0: none is."""
    return every > 0 and index % every == 0


def evenly_spaced(items: Sequence[T], number: int) -> list[T]:
    """``number`` of the items, evenly spaced from the first to the last; all if there are fewer.
    Positions are rounded to integers, halves to even ones, as in RegNeRF (Niemeyer et al. 2022)."""
    places = np.linspace(0, len(items) - 1, min(number, len(items))).round().astype(int)
    return [items[i] for i in places]


def view_size(width: int, height: int, max_long_side: int) -> tuple[int, int]:
    """Width and height in pixels, reduced so that neither exceeds ``max_long_side``; the aspect
    ratio stays the same up to rounding."""
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
    """The photographs that have a pose, as views sorted by name.

    Large photographs become smaller views; intrinsics are scaled by the exact ratios of widths and
    of heights.

    Args:
        views: The largest side of a view, and whether masks are used.
        split: The choice of test views. Those of ``train_views`` are marked in the manifest.

    Raises:
        ValueError: a camera has lens distortion; undistort the photographs first.
    """
    posed = model.by_name()
    photos = sorted((p for p in manifest.photos if p.name in posed), key=lambda photo: photo.name)
    parts = {photo.split for photo in photos}
    marked = split.source != "every" or split.train_views is not None
    listed = marked and parts == {"train", "test"}
    # Views of one photograph are all test views or all training views: they overlap.
    sources = {name: i for i, name in enumerate(sorted({p.source or p.name for p in photos}))}
    # A single photograph is for training.
    every = split.test_every if len(sources) > 1 else 0
    result = []
    for photo in photos:
        index = sources[photo.source or photo.name]
        image = posed[photo.name]
        camera = model.cameras[image.camera_id]
        if not camera.is_pinhole:
            raise ValueError(f"{photo.name}: its {camera.model} camera has lens distortion")
        width, height = view_size(photo.width, photo.height, views.max_long_side_px)
        fx, fy, cx, cy = camera.resized(width, height).pinhole
        result.append(
            View(
                name=photo.name,
                image=photo.path,
                mask=photo.mask if views.masks == "use" else None,
                width=width,
                height=height,
                fx=fx,
                fy=fy,
                cx=cx,
                cy=cy,
                world_to_camera=image.world_to_camera,
                is_test=photo.split == "test" if listed else is_test_view(index, every),
                camera_id=image.camera_id,
                image_digest=photo.digest,
                mask_digest=photo.mask_digest if views.masks == "use" else None,
                has_listed_split=listed,
                source=photo.source,
            )
        )
    return result


def scene_extent(views: list[View]) -> float:
    """1.1 times the largest distance of a training camera from their mean, in world units.

    This is ``cameras_extent`` of 3DGS (Kerbl et al. 2023, reference code); learning rates and
    thresholds are proportional to it. If all training cameras have the same position, all views
    are used; if these have too, the extent is 1.
    """
    for chosen in ([view for view in views if not view.is_test], views):
        if chosen:
            centres = np.stack([view.centre for view in chosen])
            radius = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
            # Smaller distances are rounding errors of the poses.
            if radius > 1e-9 * float(np.abs(centres).max()):
                return 1.1 * radius
    return 1.0


def scene_up(views: Sequence[View], manifest: Manifest) -> NDArray[np.float64]:
    """The scene's up direction as a (3,) unit vector in the world: see ``up_direction``."""
    orientation = {photo.name: photo.orientation for photo in manifest.photos}
    rotations = np.stack([view.world_to_camera[:3, :3] for view in views])
    return up_direction(rotations, [orientation[view.name] for view in views])


def camera_views(model: Reconstruction, max_long_side: int | None) -> list[View]:
    """The images of a model as views without photographs, sorted by name.

    Lens distortion is ignored. A parent folder that all images have in common is removed from
    the names.

    Args:
        max_long_side: The longest side in pixels, to which larger views are reduced; None for no
            limit.
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


def resized(view: View, width: int, height: int) -> View:
    """The view at another size, with intrinsics scaled by the exact ratios."""
    sx, sy = width / view.width, height / view.height
    return replace(
        view,
        width=width,
        height=height,
        fx=view.fx * sx,
        fy=view.fy * sy,
        cx=view.cx * sx,
        cy=view.cy * sy,
    )


def reduced_size(view: View, factor: int) -> tuple[int, int]:
    """(width, height) of the view divided by ``factor``, rounded, at least 1."""
    return max(1, round(view.width / factor)), max(1, round(view.height / factor))
