"""Reading a scene's given poses from any supported file, for the photographs that are used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.cameras import Camera
from pipeline.geometry.distortion import unproject
from pipeline.io.colmap import read_model, write_model
from pipeline.io.names import NameIndex, match_names
from pipeline.io.poses.formats import format_of
from pipeline.io.poses.kinds import PoseKind
from pipeline.runtime.errors import UserError
from pipeline.scene.georeference import GIVEN_UNIT, CartesianOrigin, Georeference
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.normalization import Normalization
from pipeline.scene.reconstruction import Points, PosedImage, Reconstruction
from pipeline.scene.unrounded import Rounding, Unrounded

# The relative difference of the aspect ratios of a photograph and its camera; rounding in reduced
# copies causes less.
_ASPECT_TOLERANCE = 0.02
# Gaussians are float32 with 24 bits. A scene farther from the origin than this many times its own
# size has fewer than 17 bits left: a hundredth of a pixel at a focal length of 1000 pixels.
_MAX_DISTANCE = 100.0
# Scenes are scaled by a power of 1000 to a size (median distance of the points, or the cameras,
# from the mean camera) from this up to 1000 times this. Millimetres, metres and kilometres
# therefore give the same numbers, and scenes of moderate size are not scaled.
_MIN_SIZE = 0.1
# The accepted focal lengths divided by the longer side: fields of view of 175 to 0.06 degrees.
_FOCAL_RANGE = (0.02, 1000.0)
# The accepted distance of the principal point from the image's centre divided by the longer side: a
# crop from the border of a much larger image has one outside of it.
_MAX_SHIFT = 10.0
# The accepted distance of a camera from the origin, in any unit: its square fits into float32.
MAX_COORDINATE = 1e18


@dataclass(frozen=True)
class GivenModel:
    """A scene's given poses and points, near the origin, of moderate size and rounded.

    Attributes:
        model: The model in the scene's world, rounded.
        normalization: The transformation from the given world to the scene's; the identity if the
            given poses are near their origin and of moderate size.
        unrounded: The model in the given world.
    """

    model: Reconstruction
    normalization: Normalization
    unrounded: Unrounded = field(default_factory=Unrounded)

    @classmethod
    def of(cls, given: Reconstruction, path: Path) -> GivenModel:
        """The model of the given world, read from ``path``.

        Raises:
            UserError: Positions overflow.
        """
        normalization, rounding = _frame(given, path)
        model = rounding.model(normalization.model_to_scene(given))
        return cls(model, normalization, Unrounded.of(given, rounding))

    def without_points(self) -> GivenModel:
        """The poses alone."""
        return replace(
            self,
            model=replace(self.model, points=Points.empty()),
            unrounded=replace(self.unrounded, points=np.zeros((0, 3))),
        )

    def to_scene(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The (..., 3) points of the given world, in the scene's world and rounded."""
        return self.unrounded.rounding.points(self.normalization.to_scene(points))

    def georeference(self) -> Georeference | None:
        """The content of ``georeference.json``; None if the scene's world is the given one."""
        if self.normalization.is_identity:
            return None
        scale, (x, y, z) = self.normalization.scale, self.normalization.origin.tolist()
        return Georeference(
            method="given",
            axes="those of the given poses",
            unit=GIVEN_UNIT if scale == 1 else f"{1 / scale:g} times {GIVEN_UNIT}",
            origin=CartesianOrigin(x=x, y=y, z=z),
            projection=None,
            scale=scale,
            rotation=np.eye(3).tolist(),
            translation=(-scale * self.normalization.origin).tolist(),
            residuals_m=None,
            residuals=(),
        )

    def write(self, folder: Path) -> list[str]:
        """Write ``sparse/0``, ``unrounded.npz`` and, if the scene's world is not the given
        one, ``georeference.json`` into ``folder``.

        Returns:
            Messages about the translation and the scale.
        """
        write_model(folder / "sparse" / "0", self.model)
        self.unrounded.write(folder)
        georeference = self.georeference()
        if georeference is None:
            return []
        georeference.write(folder)
        messages = []
        if self.normalization.origin.any():
            origin = ", ".join(f"{value:.9g}" for value in self.normalization.origin)
            messages.append(
                "the given poses are too far from their origin for float32: the scene is "
                f"translated, and its origin is {origin} in the given world (frame.json)"
            )
        if self.normalization.scale != 1:
            messages.append(
                f"the scene is computed in a unit of {1 / self.normalization.scale:g} given "
                "units; exported files are in the given unit"
            )
        return messages


@dataclass(frozen=True)
class GivenFiles:
    """The pose files of a scene.

    Attributes:
        path: The pose file or its folder.
        kind: The format of the file.
        listed: The names of all photographs, also of those that are not used. Only LLFF needs them.
        base_folder: The folder of the photographs relative to the scene folder, for formats whose
            names are relative to the latter.
    """

    path: Path
    kind: PoseKind
    listed: tuple[str, ...] = ()
    base_folder: str = "."


def load_given(
    path: Path,
    kind: PoseKind,
    photos: Sequence[Photo],
    listed: Sequence[str] = (),
    base_folder: str = ".",
) -> GivenModel:
    """Read given poses, with images named and cameras sized as the photographs, near the origin.

    Points keep their observations in these photographs; points observed in none are dropped.

    Args:
        path, kind, listed, base_folder: The fields of ``GivenFiles``.
        photos: The photographs that are used.

    Raises:
        UserError: A pose file is malformed, or a camera has another aspect ratio than its
            photograph or an impossible focal length.
    """
    files = GivenFiles(path, kind, tuple(listed), base_folder)
    return GivenModel.of(read_fitted(files, photos), path)


def read_fitted(
    files: GivenFiles, photos: Sequence[Photo], *, points: bool = True
) -> Reconstruction:
    """The model of ``load_given`` in the given world, or only its cameras and images.

    Args:
        points: Whether to read the points of a COLMAP model, which takes longest.

    Raises:
        UserError: See ``load_given``.
    """
    by_name = {photo.name: photo for photo in photos}
    entry = format_of(files.kind)
    prefix = entry.prefix(files.base_folder)
    if files.kind == "colmap" and not points:
        model = read_model(files.path, points=False)
    else:
        sizes = {prefix + photo.name: (photo.width, photo.height) for photo in photos}
        model = entry.read(files.path, sizes, files.listed)
    if prefix:
        images = {
            i: replace(image, name=image.name.removeprefix(prefix))
            for i, image in model.images.items()
        }
        model = replace(model, images=images)
    return fit_to_photos(model, by_name, str(files.path))


def _frame(model: Reconstruction, path: Path) -> tuple[Normalization, Rounding]:
    """The normalization of a model that is far from its origin or in an extreme unit, and the
    rounding in the scene's world.

    Raises:
        UserError: Positions overflow.
    """
    if not model.images:
        return Normalization(), Rounding()
    centres = np.stack([image.centre for image in model.images.values()])
    extent = model.points.xyz if len(model.points) else centres
    with np.errstate(over="ignore", invalid="ignore"):
        mean = centres.mean(0)
        size = float(np.median(np.linalg.norm(extent - mean, axis=1)))
    if not (np.isfinite(mean).all() and np.isfinite(size)):
        raise UserError(
            f"expected camera positions of moderate size, found {np.abs(centres).max():g}",
            file=path,
            fix="give the poses in another unit, or set poses: ignore",
        )
    # For cameras in one place without points, rounding errors are no size.
    if size <= 1e-12 * np.abs(mean).max():
        return Normalization(), Rounding()
    # The size is rounded, so that it is readable and rarely changes when photographs are added.
    step = 10.0 ** np.ceil(np.log10(size))
    far = np.abs(mean).max() > _MAX_DISTANCE * size
    origin = np.round(mean / step) * step if far else np.zeros(3)
    thousands = int(np.floor(np.log10(size / _MIN_SIZE) / 3))
    scale = float(1000.0**-thousands)
    return Normalization(scale, origin), Rounding.of_size(scale * size)


def fit_to_photos(
    model: Reconstruction, photos: Mapping[str, Photo], source: str
) -> Reconstruction:
    """``model`` reduced to the images that are photographs, with their names, and with cameras
    resized to them.

    Names match as in ``match_names``. Image ids do not change; the second photograph of an image
    and further ones get new ids, without observations.

    Args:
        photos: The photographs by name.
        source: The pose file, for error messages.

    Raises:
        UserError: Names are ambiguous, or a camera has another aspect ratio than its photograph or
            an impossible focal length.
    """
    matched: dict[str, list[str]] = {}
    for name, listed in match_names(_names(model), photos, source).items():
        matched.setdefault(listed, []).append(name)
    images: dict[int, PosedImage] = {}
    cameras: dict[int, Camera] = {}
    ids: dict[tuple[int, int, int], int] = {}
    scale: dict[int, tuple[float, float]] = {}
    last_id, last_image = max(model.cameras, default=0), max(model.images, default=0)
    pairs = [
        (number, image, name)
        for number, image in sorted(model.images.items())
        for name in matched.pop(image.name, [])
    ]
    for number, image, name in pairs:
        if number in images:
            last_image += 1
            number = last_image
        photo, camera = photos[name], model.cameras[image.camera_id]
        _check_camera(photo, camera, source)
        _check_centre(image, source)
        key = (image.camera_id, photo.width, photo.height)
        if key not in ids:
            _check_distortion(photo, camera, source)
            if image.camera_id in cameras:
                last_id += 1
            ids[key] = last_id if image.camera_id in cameras else image.camera_id
            cameras[ids[key]] = (
                camera
                if (camera.width, camera.height) == key[1:]
                else camera.resized(photo.width, photo.height)
            )
        scale[number] = photo.width / camera.width, photo.height / camera.height
        images[number] = PosedImage(name, ids[key], image.rotation, image.translation)
    return Reconstruction(cameras, images, _points_in(model.points, scale))


def _names(model: Reconstruction) -> list[str]:
    """The names of the images in the order of their ids."""
    return [image.name for _, image in sorted(model.images.items())]


def _check_camera(photo: Photo, camera: Camera, source: str) -> None:
    size = camera.width, camera.height
    longer = max(size)
    relative = [focal / longer for focal in camera.pinhole[:2]]
    if not (_FOCAL_RANGE[0] <= min(relative) and max(relative) <= _FOCAL_RANGE[1]):
        raise UserError(
            f"{photo.name}: its given camera has an impossible focal length of "
            f"{camera.pinhole[0]:g} pixels at {camera.width}x{camera.height}"
            + _other_unit(camera.pinhole[0]),
            file=source,
            fix="give focal lengths in pixels of the images, or set poses: ignore",
        )
    shift = max(abs(x - s / 2) for x, s in zip(camera.pinhole[2:], size, strict=True))
    if not shift <= _MAX_SHIFT * longer:
        raise UserError(
            f"{photo.name}: its given camera has an impossible principal point of "
            f"{camera.pinhole[2]:g}, {camera.pinhole[3]:g} pixels at {size[0]}x{size[1]}",
            file=source,
            fix="give principal points in pixels of the images, or set poses: ignore",
        )
    expected, found = camera.width / camera.height, photo.width / photo.height
    # Either side of a reduced copy may be rounded by one pixel.
    tolerance = _ASPECT_TOLERANCE + 1 / min(photo.width, photo.height)
    if abs(found / expected - 1) > tolerance:
        if abs(found * expected - 1) <= tolerance:
            raise UserError(
                f"{photo.name} is {photo.width}x{photo.height}, its given camera "
                f"{camera.width}x{camera.height}: width and height (w and h) are swapped",
                file=source,
                fix="exchange them in the file; if the poses were computed from turned "
                "photographs, use those (stored orientation), or set poses: ignore",
            )
        raise UserError(
            f"{photo.name} is {photo.width}x{photo.height}, its given camera "
            f"{camera.width}x{camera.height}: the aspect ratios differ",
            file=source,
            fix="use the photographs that the poses were computed from (stored orientation, not "
            "cropped), or set poses: ignore",
        )


def _other_unit(focal: float) -> str:
    """The unit that an impossibly short focal length is probably given in."""
    if focal < 4:
        return "; it looks like a fraction of the image's side"
    return "; it looks like millimetres" if focal < 100 else ""


def _check_centre(image: PosedImage, source: str) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        distance = float(np.abs(image.centre).max())
    if not distance <= MAX_COORDINATE:  # This includes NaN from an overflow.
        raise UserError(
            f"{image.name}: expected a camera at most {MAX_COORDINATE:g} units from the origin, "
            f"found {distance:g}",
            file=source,
            fix=f"correct its translation or remove {image.name} from the file, or set poses: "
            "ignore",
        )


def _check_distortion(photo: Photo, camera: Camera, source: str) -> None:
    """Check that the distortion can be undone in at least a tenth of the image; otherwise
    undistorted images would be almost blank."""
    if camera.is_pinhole:
        return
    share = (np.arange(9) + 0.5) / 9
    grid = np.stack(np.meshgrid(share * camera.width, share * camera.height), axis=-1)
    with np.errstate(all="ignore"):
        undone = np.isfinite(unproject(camera, grid)).all(-1)
    if undone.mean() < 0.1:
        found = ", ".join(f"{value:g}" for value in camera.distortion)
        raise UserError(
            f"{photo.name}: its given camera has an impossible lens distortion ({camera.model}: "
            f"{found}): it cannot be undone",
            file=source,
            fix="correct the distortion coefficients, or set poses: ignore",
        )


def _points_in(points: Points, scale: Mapping[int, tuple[float, float]]) -> Points:
    """The points observed in images of ``scale``, with pixels multiplied by its (x, y) factors."""
    if not len(points):
        return points
    numbers, inverse = np.unique(points.track_image_id, return_inverse=True)
    unseen = (np.nan, np.nan)
    factors = np.array([scale.get(int(n), unseen) for n in numbers], np.float64).reshape(-1, 2)
    row_factor = factors[inverse]
    kept = ~np.isnan(row_factor[:, 0])
    owner = np.repeat(np.arange(len(points)), points.track_length)
    length = np.bincount(owner[kept], minlength=len(points))
    # Points without tracks are kept: it is unknown in which images they are visible.
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
    """The model with its images renamed to the manifest's photographs, which match without suffix;
    images without a photograph are dropped."""
    index = NameIndex(photo.name for photo in manifest.photos)
    images = {
        i: replace(image, name=name)
        for i, image in model.images.items()
        if (name := index.find(image.name)) is not None
    }
    return Reconstruction(model.cameras, images, model.points)
