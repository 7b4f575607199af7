"""pycolmap reconstructions: build from known poses, colour, write."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.keypoints import Keypoints

Colors = dict[int, NDArray[np.uint8]]


def posed_model(
    cameras: Sequence[pycolmap.Camera],
    images: Sequence[tuple[int, str, int]],
    poses: Sequence[pycolmap.Rigid3d],
) -> pycolmap.Reconstruction:
    """A model of registered images without points.

    Args:
        images: (image id, name, camera id).
        poses: world to camera, in the same order.
    """
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    for (image_id, name, camera_id), pose in zip(images, poses, strict=True):
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(image, pose)
    return model


def read_colors(files: dict[int, Path]) -> Colors:
    """Read keypoint colours: image id -> keypoint file to image id -> (F, 3) uint8 RGB."""
    return {image_id: Keypoints.read(file).rgb for image_id, file in files.items()}


def color_points(model: pycolmap.Reconstruction, colors: Colors) -> None:
    """Set each point's colour to the mean colour of its observations."""
    for point in model.points3D.values():
        seen = [colors[e.image_id][e.point2D_idx] for e in point.track.elements]
        point.color = np.rint(np.mean(seen, axis=0)).astype(np.uint8)


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write ``model`` in COLMAP's binary format to ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
