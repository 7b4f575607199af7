"""Rounding of given poses and points, so that their unit and origin change no bit of a result.

Differences of coordinates far from their origin have rounding errors, and so has a change of the
unit. Training amplifies errors of any size, because whether a Gaussian is split is a matter of yes
or no. Cameras and points of the scene's world are therefore rounded far above these errors, and
far below what a pixel shows. Exported files have the given values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.rotations import quat_to_rotation, rotation_to_quat
from pipeline.runtime.atomic import written
from pipeline.scene.normalization import Normalization
from pipeline.scene.reconstruction import PosedImage, Reconstruction

Array = NDArray[np.float64]

FILE = "unrounded.npz"
# The steps are relative to the size of the scene. Cameras have the resolution of float32, in which
# Gaussians are stored. Points are thousands of times as many: a coarser step leaves few of them
# within a rounding error of where the nearest multiple changes.
_CENTRE_STEP = 2.0**-22
_POINT_STEP = 2.0**-17
# The rounding step of unit quaternions' elements.
_QUATERNION_STEP = 2.0**-40
# Values that are written, read and computed with anew differ by less, refined ones by more.
_CENTRE_DRIFT, _ROTATION_DRIFT = 2.0**-12 * _CENTRE_STEP, 2.0**-46


@dataclass(frozen=True)
class Rounding:
    """Rounding for a scene of ``size``, a power of two in its own unit; 0: nothing is rounded."""

    size: float = 0.0

    @classmethod
    def of_size(cls, size: float) -> Rounding:
        """That of the largest power of two that is not larger than ``size``, which is positive."""
        return cls(2.0 ** math.floor(math.log2(size)))

    def model(self, model: Reconstruction) -> Reconstruction:
        """The model with rounded poses and points."""
        if not self.size:
            return model
        images = {number: self.image(image) for number, image in model.images.items()}
        points = replace(model.points, xyz=self.points(model.points.xyz))
        return Reconstruction(model.cameras, images, points)

    def image(self, image: PosedImage) -> PosedImage:
        """The image with rounded centre and rotation."""
        if not self.size:
            return image
        quaternion = _multiple(rotation_to_quat(image.rotation), _QUATERNION_STEP)
        rotation = quat_to_rotation(quaternion)
        return replace(image, rotation=rotation, translation=-rotation @ self.centre(image))

    def centre(self, image: PosedImage) -> Array:
        """(3,) the rounded centre."""
        return _multiple(image.centre, self.size * _CENTRE_STEP)

    def points(self, points: Array) -> Array:
        """(..., 3) rounded points."""
        return _multiple(points, self.size * _POINT_STEP) if self.size else points


@dataclass(frozen=True)
class Unrounded:
    """Given poses and points before they were rounded, in the given world.

    Attributes:
        rounding: How they were rounded in the scene's world.
        rotations: (N, 3, 3) float64, world to camera.
        translations: (N, 3) float64, world to camera.
        points: (P, 3) float64, in the order of the model's points.
    """

    rounding: Rounding = field(default_factory=Rounding)
    rotations: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    translations: Array = field(default_factory=lambda: np.zeros((0, 3)))
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def of(cls, model: Reconstruction, rounding: Rounding) -> Unrounded:
        """Those of a model of the given world."""
        images = model.images.values()
        rotations = np.array([image.rotation for image in images]).reshape(-1, 3, 3)
        translations = np.array([image.translation for image in images]).reshape(-1, 3)
        return cls(rounding, rotations, translations, model.points.xyz)

    def write(self, folder: Path) -> None:
        """Write ``unrounded.npz``, atomically and deterministically."""
        arrays = vars(self).copy()
        size = np.array([arrays.pop("rounding").size])
        with written(folder / FILE) as file:
            np.savez(file, size=size, **arrays)

    @classmethod
    def read(cls, folder: Path) -> Unrounded:
        """Those written into ``folder``; none if it has no such file."""
        if not (folder / FILE).is_file():
            return cls()
        with np.load(folder / FILE) as archive:
            rounding = Rounding(float(archive["size"][0]))
            return cls(rounding, archive["rotations"], archive["translations"], archive["points"])

    def model_to_given(self, model: Reconstruction, frame: Normalization) -> Reconstruction:
        """A model of the scene's world, in the given world. Poses and points that are still the
        rounded ones become the given ones; a view that was cut out of a photograph gets the
        photograph's given centre.

        Args:
            frame: The transform from the given world to the scene's.
        """
        moved = frame.model_to_given(model)
        if not self.rounding.size:
            return moved
        known = self._by_centre(frame)
        images = {}
        for number, image in model.images.items():
            given = known.get(tuple(self.rounding.centre(image).tolist()), [])
            images[number] = self._restored(image, given) or moved.images[number]
        xyz = moved.points.xyz
        if len(xyz) == len(self.points):
            rounded = self.rounding.points(frame.to_scene(self.points))
            same = (model.points.xyz == rounded).all(1)
            xyz = np.where(same[:, None], self.points, xyz)
        return Reconstruction(moved.cameras, images, replace(moved.points, xyz=xyz))

    def _by_centre(
        self, frame: Normalization
    ) -> dict[tuple[float, ...], list[tuple[PosedImage, PosedImage]]]:
        """Rounded centre -> the given images there, each as rounded and as given."""
        found: dict[tuple[float, ...], list[tuple[PosedImage, PosedImage]]] = {}
        for rotation, translation in zip(self.rotations, self.translations, strict=True):
            given = PosedImage("", 0, rotation, translation)
            rounded = self.rounding.image(frame.image_to_scene(given))
            key = tuple(self.rounding.centre(rounded).tolist())
            found.setdefault(key, []).append((rounded, given))
        return found

    def _restored(
        self, image: PosedImage, candidates: list[tuple[PosedImage, PosedImage]]
    ) -> PosedImage | None:
        """The image with the given pose if its pose is a rounded one of ``candidates``, with the
        given centre if its centre is; None if neither is."""
        size, result = self.rounding.size, None
        for rounded, given in candidates:
            if np.abs(image.centre - rounded.centre).max() > size * _CENTRE_DRIFT:
                continue
            if np.abs(image.rotation - rounded.rotation).max() <= _ROTATION_DRIFT:
                return replace(image, rotation=given.rotation, translation=given.translation)
            result = result or replace(image, translation=-image.rotation @ given.centre)
        return result


def _multiple(values: Array, step: float) -> Array:
    """The nearest multiples of ``step``, which is a power of two: products are exact."""
    return np.asarray(np.rint(values / step) * step)
