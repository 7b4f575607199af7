"""Registered images of a pycolmap model with their keypoints, for the quality check.

COLMAP's normalised coordinates end at 90 degrees from the optical axis, and its rays of fisheye
lenses too; ``geometry.rays`` has no such limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.geometry import rays
from pipeline.geometry.cameras import Camera

Floats = NDArray[np.float64]
Pairs = dict[tuple[int, int], NDArray[np.uint32]]
"""Image ids -> (M, 2) verified matches."""


@dataclass(frozen=True, eq=False)
class ModelView:
    """A registered image.

    Attributes:
        camera: The camera of the image.
        rotation, translation: World to camera, (3, 3) and (3,).
        xy: (F, 2) keypoints, pixels.
        observed: (F,) id of the 3D point that each keypoint observes; -1 for none.
    """

    camera: pycolmap.Camera
    rotation: Floats
    translation: Floats
    xy: Floats
    observed: NDArray[np.int64]

    @cached_property
    def points(self) -> NDArray[np.int64]:
        """The sorted ids of the observed 3D points."""
        found = np.unique(self.observed)
        return found[found >= 0]

    @property
    def centre(self) -> Floats:
        """(3,) the camera's centre in the world."""
        return -self.rotation.T @ self.translation

    @property
    def is_panorama(self) -> bool:
        return bool(self.camera.is_spherical())

    @property
    def is_wide(self) -> bool:
        """Whether the camera may see at 90 degrees or more from its optical axis."""
        return self.is_panorama or "FISHEYE" in self.camera.model_name

    @cached_property
    def rays(self) -> Floats:
        """(F, 3) unit rays of the keypoints; NaN where there is none."""
        return camera_rays(self.camera, self.xy)

    @cached_property
    def plane(self) -> Floats:
        """(F, 3) rays of the keypoints with z = 1, of a camera that is not wide."""
        flat = np.asarray(self.camera.cam_from_img(self.xy), np.float64).reshape(-1, 2)
        return np.column_stack([flat, np.ones(len(flat))])

    @property
    def side(self) -> float:
        """The longer side in pixels, to which tolerances are relative; of a panorama the width of
        90 degrees, which an ordinary photograph may show."""
        return self.camera.width / 4 if self.is_panorama else float(self.longer_side)

    @property
    def longer_side(self) -> int:
        """The longer side of the image, pixels."""
        return max(self.camera.width, self.camera.height)

    @property
    def focal(self) -> float:
        """The focal length in pixels; of a panorama the pixels per radian at its centre."""
        return pixels_per_radian(self.camera)

    def projected(self, xyz: Floats) -> Floats:
        """(P, 2) pixels of (P, 3) points of the world; NaN where there is none."""
        local = xyz @ self.rotation.T + self.translation
        if self.is_wide:
            return rays.pixels(_plain(self.camera), local)
        xy, in_front = np.full((len(xyz), 2), np.nan), local[:, 2] > 1e-9
        if in_front.any():
            found = self.camera.img_from_cam(local[in_front])
            xy[in_front] = np.asarray(found, np.float64).reshape(-1, 2)
        return xy


def read_views(model: pycolmap.Reconstruction, database: pycolmap.Database) -> dict[int, ModelView]:
    """Image id -> image, for the registered images of a model in the order of their ids."""
    views = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        pose = image.cam_from_world()
        xy = database.read_keypoints(image_id)[:, :2].astype(np.float64)
        observed = np.full(len(xy), -1, np.int64)
        for index, point2D in enumerate(image.points2D):
            if point2D.has_point3D():
                observed[index] = point2D.point3D_id
        camera, translation = model.camera(image.camera_id), np.asarray(pose.translation)
        views[image_id] = ModelView(camera, pose.rotation.matrix(), translation, xy, observed)
    return views


def camera_rays(camera: pycolmap.Camera, xy: Floats) -> Floats:
    """(N, 3) unit rays through (N, 2) pixels; NaN where there is none."""
    return rays.rays(_plain(camera), xy)


def pixels_per_radian(camera: pycolmap.Camera) -> float:
    """The focal length in pixels; of a panorama the pixels per radian at its centre."""
    if camera.is_spherical():
        return float(camera.width / (2 * np.pi))
    return float(camera.mean_focal_length())


def _plain(camera: pycolmap.Camera) -> Camera:
    params = np.array(camera.params, np.float64)
    return Camera(camera.model_name, camera.width, camera.height, params)
