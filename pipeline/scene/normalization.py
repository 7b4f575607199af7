"""The translation and scale between the world of given poses and the scene's world.

Gaussians are float32, and single numbers of their optimisation have a fixed size. Given poses far
from their origin or in a very large or small unit are therefore moved near the origin and scaled
before anything is computed from them. Exported files are in the given unit again.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.scene.reconstruction import PosedImage, Reconstruction
from pipeline.scene.views import View

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Normalization:
    """``scene = scale * (given - origin)``. Axes and cameras' rotations are equal in both worlds.

    Attributes:
        scale: The number of scene units in one unit of the given world.
        origin: (3,) float64, the scene's origin in the given world.
    """

    scale: float = 1.0
    origin: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def is_identity(self) -> bool:
        return self.scale == 1 and not self.origin.any()

    def to_scene(self, points: Array) -> Array:
        """(..., 3) points of the given world, in the scene's world."""
        return np.asarray((points - self.origin) * self.scale)

    def to_given(self, points: Array) -> Array:
        """(..., 3) points of the scene's world, in the given world."""
        return np.asarray(points / self.scale + self.origin)

    def without_origin(self) -> Normalization:
        """The scale alone: its given world has the unit of the given poses and the scene's
        origin, so that coordinates fit into float32."""
        return Normalization(self.scale)

    def model_to_scene(self, model: Reconstruction) -> Reconstruction:
        """A model of the given world, in the scene's world."""
        if self.is_identity:
            return model
        images = {number: self.image_to_scene(image) for number, image in model.images.items()}
        points = replace(model.points, xyz=self.to_scene(model.points.xyz))
        return Reconstruction(model.cameras, images, points)

    def image_to_scene(self, image: PosedImage) -> PosedImage:
        """An image of the given world, in the scene's world."""
        if self.is_identity:
            return image
        moved = image.rotation @ (self.scale * (self.origin - image.centre))
        return replace(image, translation=moved)

    def model_to_given(self, model: Reconstruction) -> Reconstruction:
        """A model of the scene's world, in the given world."""
        if self.is_identity:
            return model
        images = {
            number: replace(image, translation=-image.rotation @ self.to_given(image.centre))
            for number, image in model.images.items()
        }
        points = replace(model.points, xyz=self.to_given(model.points.xyz))
        return Reconstruction(model.cameras, images, points)

    def view_to_given(self, view: View) -> View:
        """A view of the scene's world, in the given world."""
        if self.is_identity:
            return view
        pose = view.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ self.to_given(view.centre)
        return replace(view, world_to_camera=pose)


IDENTITY = Normalization()
