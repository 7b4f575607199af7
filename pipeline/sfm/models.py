"""pycolmap's cameras and reconstructions: focal lengths, known poses, colours, files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

Colors = Mapping[int, NDArray[np.uint8]]

# COLMAP's default focal length over the longer side without a prior (about 45 degrees).
DEFAULT_FOCAL_FACTOR = 1.2


def quiet_colmap() -> None:
    """Set pycolmap's log level to fatal errors; its results are checked instead.

    ``pycolmap.bundle_adjustment`` resets the level: call this again after it.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value


def is_uncalibrated(camera: pycolmap.Camera) -> bool:
    """Whether the camera is a fisheye lens without a prior of its focal length."""
    return "FISHEYE" in camera.model_name and not camera.has_prior_focal_length


def with_prior(camera: pycolmap.Camera) -> pycolmap.Camera:
    """A copy whose pairs are verified by the essential matrix."""
    copy = pycolmap.Camera(camera.todict())
    copy.has_prior_focal_length = True
    return copy


def set_focal(camera: pycolmap.Camera, focal: float) -> None:
    """Set all focal lengths of a camera, pixels."""
    params = np.array(camera.params)
    params[list(camera.focal_length_idxs())] = focal
    camera.params = params.tolist()


def uncalibrated(
    camera: pycolmap.Camera, focal: float = DEFAULT_FOCAL_FACTOR, model: str | None = None
) -> pycolmap.Camera:
    """The camera with initial parameters and without a prior.

    Args:
        focal: The focal length over the longer side.
        model: The camera model; None for that of ``camera``.
    """
    width, height = camera.width, camera.height
    return pycolmap.Camera.create_from_model_name(
        camera.camera_id, model or camera.model_name, focal * max(width, height), width, height
    )


def posed_model(
    cameras: Sequence[pycolmap.Camera],
    images: Sequence[tuple[int, str, int]],
    poses: Sequence[pycolmap.Rigid3d],
) -> pycolmap.Reconstruction:
    """A model of registered images without points.

    Args:
        images: (image id, name, camera id).
        poses: The transforms from world to camera, in the same order.
    """
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    for (image_id, name, camera_id), pose in zip(images, poses, strict=True):
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(image, pose)
    return model


def color_points(model: pycolmap.Reconstruction, colors: Colors) -> None:
    """Set each point's colour to the mean colour of its observations.

    Args:
        colors: Image id -> (F, 3) uint8 RGB of its keypoints.
    """
    points = list(model.points3D.values())
    tracks = [point.track.elements for point in points]
    # Integer sums are exact, in any order.
    sums = np.zeros((len(points), 3), np.int64)
    of_image: dict[int, tuple[list[int], list[int]]] = {}
    for index, track in enumerate(tracks):
        for element in track:
            rows, keypoints = of_image.setdefault(element.image_id, ([], []))
            rows.append(index)
            keypoints.append(element.point2D_idx)
    for image_id, (rows, keypoints) in of_image.items():
        np.add.at(sums, rows, colors[image_id][keypoints].astype(np.int64))
    for point, total, track in zip(points, sums, tracks, strict=True):
        point.color = np.rint(total / len(track)).astype(np.uint8)


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write ``model`` in COLMAP's binary format to ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
