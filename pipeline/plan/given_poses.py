"""The poses a scene brings, whatever file they come in, for the photographs that are used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import read_model, write_model
from pipeline.io.llff import read_poses_bounds
from pipeline.io.names import NameIndex
from pipeline.io.transforms import read_transforms
from pipeline.plan.scan import Scan
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction

# Of a stage with poses: what frame they are in, where they are not as they were given.
GEOREFERENCE = "georeference.json"
# Shapes of a photograph and of its camera differ by rounding in reduced copies, not by more.
_ASPECT_TOLERANCE = 0.02
# Gaussians and most files of them are float32, of 24 bits. A scene farther from the origin than
# this many of its own sizes has fewer than 17 left: a hundredth of a pixel at a focal length of
# 1000 pixels.
_FAR = 100.0

# Focal lengths over the longer side, from 175 degrees of view to a twentieth of one.
_LENSES = (0.02, 1000.0)


@dataclass(frozen=True)
class Given:
    """The poses a scene brings.

    Attributes:
        model: in the given world, moved by ``-origin``.
        origin: (3,) float64, a round place near the cameras where the scene is too far from the
            given world's zero for float32; else zeros.
    """

    model: Reconstruction
    origin: NDArray[np.float64]

    def sidecar(self) -> dict[str, Any] | None:
        """The content of ``georeference.json``; None where nothing was moved."""
        if not self.origin.any():
            return None
        return {
            "method": "given",
            "axes": "those of the given poses",
            "origin": dict(zip("xyz", self.origin.tolist(), strict=True)),
            "projection": None,
            "scale": 1.0,
            "rotation": np.eye(3).tolist(),
            "translation": (-self.origin).tolist(),
        }

    def write(self, folder: Path) -> list[str]:
        """Write ``sparse/0`` and, where the poses were moved, ``georeference.json`` into
        ``folder``; returns the sentence that says so."""
        write_model(folder / "sparse" / "0", self.model)
        moved = self.sidecar()
        if moved is None:
            return []
        write_json(folder / GEOREFERENCE, moved)
        origin = ", ".join(f"{value:.9g}" for value in self.origin)
        return [
            "the given poses are too far from their origin for float32: everything is moved so "
            f"that {origin} is the new one (frame.json)"
        ]


def load_given(scan: Scan) -> Given:
    """Poses in COLMAP's convention, named by and sized for the photographs of the manifest, near
    the origin.

    Points keep the observations in those photographs; points seen in none of them are dropped.

    Raises:
        UserError: malformed pose files; a camera of another shape than its photograph.
        ValueError: the scan found no poses.
    """
    if scan.poses is None:
        raise ValueError("the scan found no poses")
    path = scan.folder / scan.poses.path
    photos = {photo.name: photo for photo in scan.photos}
    sizes = {name: (photo.width, photo.height) for name, photo in photos.items()}
    if scan.poses.kind == "transforms":
        prefix = "" if scan.base_folder == "." else f"{scan.base_folder}/"
        model = read_transforms(path, {prefix + name: size for name, size in sizes.items()})
        model = Reconstruction(
            model.cameras,
            {
                i: PosedImage(im.name[len(prefix) :], im.camera_id, im.rotation, im.translation)
                for i, im in model.images.items()
            },
        )
    elif scan.poses.kind == "llff":
        # Rows go by order, so files that cannot be read still count; they are dropped below.
        model, _ = read_poses_bounds(path, scan.listed)
    else:
        model = read_model(path)
    return _near_origin(fit_to_photos(model, photos, str(path)))


def _near_origin(model: Reconstruction) -> Given:
    if not model.images:
        return Given(model, np.zeros(3))
    centres = np.stack([image.centre for image in model.images.values()])
    mean = centres.mean(0)
    seen = model.points.xyz if len(model.points) else centres
    size = float(np.median(np.linalg.norm(seen - mean, axis=1)))
    if size == 0 or np.abs(mean).max() <= _FAR * size:
        return Given(model, np.zeros(3))
    # Round, so that a photograph more or less gives the same origin, and people can read it.
    step = 10.0 ** np.ceil(np.log10(size))
    origin = np.round(mean / step) * step
    images = {
        number: replace(image, translation=image.rotation @ (origin - image.centre))
        for number, image in model.images.items()
    }
    points = replace(model.points, xyz=model.points.xyz - origin)
    return Given(Reconstruction(model.cameras, images, points), origin)


def fit_to_photos(
    model: Reconstruction, photos: Mapping[str, Photo], source: str
) -> Reconstruction:
    """``model`` for the photographs at hand: renamed to them, cameras resized, others dropped.

    Names match exactly or without their suffix. Ids of images stay.

    Raises:
        UserError: a camera of another shape than its photograph, or with a focal length that no
            lens has; ``source`` names the poses.
    """
    index = NameIndex(photos)
    images: dict[int, PosedImage] = {}
    cameras: dict[int, Camera] = {}
    ids: dict[tuple[int, int, int], int] = {}
    scale: dict[int, tuple[float, float]] = {}
    fresh = max(model.cameras, default=0)
    taken: set[str] = set()
    for number, image in sorted(model.images.items()):
        name = index.find(image.name)
        if name is None or name in taken:
            continue
        taken.add(name)
        photo, camera = photos[name], model.cameras[image.camera_id]
        _check_camera(photo, camera, source)
        key = (image.camera_id, photo.width, photo.height)
        if key not in ids:
            if image.camera_id in cameras:
                fresh += 1
            ids[key] = fresh if image.camera_id in cameras else image.camera_id
            cameras[ids[key]] = (
                camera
                if (camera.width, camera.height) == key[1:]
                else camera.resized(photo.width, photo.height)
            )
        scale[number] = photo.width / camera.width, photo.height / camera.height
        images[number] = PosedImage(name, ids[key], image.rotation, image.translation)
    return Reconstruction(cameras, images, _points_in(model.points, scale))


def _check_camera(photo: Photo, camera: Camera, source: str) -> None:
    longer = max(camera.width, camera.height)
    lens = [focal / longer for focal in camera.pinhole[:2]]
    if not (_LENSES[0] <= min(lens) and max(lens) <= _LENSES[1]):
        raise UserError(
            f"{photo.name}: its given camera has a focal length of {camera.pinhole[0]:g} pixels at "
            f"{camera.width}x{camera.height}, which no lens has",
            file=source,
            fix="give focal lengths in pixels of the pictures, or set poses: ignore",
        )
    want, found = camera.width / camera.height, photo.width / photo.height
    # One pixel of rounding in either side of a small copy.
    slack = _ASPECT_TOLERANCE + 1 / min(photo.width, photo.height)
    if abs(found / want - 1) > slack:
        raise UserError(
            f"{photo.name} is {photo.width}x{photo.height}, its given camera "
            f"{camera.width}x{camera.height}: another shape, so the poses are not this picture's",
            file=source,
            fix="bring the photographs the poses were made from (stored orientation, not cropped), "
            "or set poses: ignore",
        )


def _points_in(points: Points, scale: Mapping[int, tuple[float, float]]) -> Points:
    """The points seen in images of ``scale``, pixels multiplied by its (x, y) factors."""
    if not len(points):
        return points
    numbers, inverse = np.unique(points.track_image_id, return_inverse=True)
    unseen = (np.nan, np.nan)
    factors = np.array([scale.get(int(n), unseen) for n in numbers], np.float64).reshape(-1, 2)
    row_factor = factors[inverse]
    kept = ~np.isnan(row_factor[:, 0])
    owner = np.repeat(np.arange(len(points)), points.track_length)
    length = np.bincount(owner[kept], minlength=len(points))
    # Points that come without tracks are kept: nothing says that they are unseen.
    seen = (length > 0) | (points.track_length == 0)
    return Points(
        points.xyz[seen],
        points.rgb[seen],
        points.error[seen],
        np.concatenate([[0], np.cumsum(length[seen])]).astype(np.int64),
        points.track_image_id[kept],
        points.track_xy[kept] * row_factor[kept],
    )


def renamed(model: Reconstruction, manifest: Manifest) -> Reconstruction:
    """The model with its images under the manifest's names, found by their stems; those without a
    photograph are left out."""
    index = NameIndex(photo.name for photo in manifest.photos)
    images = {
        i: replace(image, name=name)
        for i, image in model.images.items()
        if (name := index.find(image.name)) is not None
    }
    return Reconstruction(model.cameras, images, model.points)
