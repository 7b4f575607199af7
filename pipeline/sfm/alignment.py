"""Align a pycolmap model to the world: by ground control points, GPS, or to a level frame."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap

from pipeline.geometry.similarity import Similarity
from pipeline.geometry.up_direction import image_directions, up_direction
from pipeline.io.gcp import GCP_FILE, read_ground_control
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.sfm.frame_comparison import contradictions
from pipeline.sfm.gcp_frame import Triangulated, from_gcp
from pipeline.sfm.georeference import Cameras, WorldFrame, level
from pipeline.sfm.gps_frame import from_gps
from pipeline.sfm.model_views import camera_rays, pixels_per_radian

Georeference = Literal["gps", "gcp", "none"]

# Smallest angle between the rays of a triangulated ground control point.
MIN_RAY_ANGLE_DEG = 1.0


def align_model(
    model: pycolmap.Reconstruction, manifest: Manifest, method: Georeference, control: Path | None
) -> WorldFrame:
    """Transform ``model`` into a world frame and return that frame.

    Args:
        method: "gcp" falls back to GPS, and "gps" to a level frame, with a warning. "none" is the
            level frame.
        control: The scene's ``gcp_list.txt``, None without one.

    Raises:
        UserError: ``gcp_list.txt`` is malformed or its coordinates are in another order or unit
            than its projection's; or ``method`` is "gcp" and there is none.
    """
    photos = {photo.name: photo for photo in manifest.photos}
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    rotations = np.stack([image.cam_from_world().rotation.matrix() for image in images])
    orientations = [photos[image.name].orientation for image in images]
    cameras = Cameras(
        names=[image.name for image in images],
        centres=np.stack([image.projection_center() for image in images]),
        up=up_direction(rotations, orientations),
        directions=image_directions(rotations, orientations),
    )
    fallbacks: list[str] = []
    frame: WorldFrame | str | None = None
    if method == "gcp" and control is None:
        raise UserError(
            "sfm.georeference is gcp, but there are no ground control points",
            file=GCP_FILE,
            fix="put the file into the scene folder, or set sfm.georeference: auto",
        )
    positions = {name: photo.gps for name, photo in photos.items() if photo.gps is not None}
    if method == "gcp" and control is not None:
        sizes = {name: (photo.width, photo.height) for name, photo in photos.items()}
        points = read_ground_control(control, sizes)
        frame = from_gcp(points, partial(_triangulate, model), cameras, control)
        if isinstance(frame, str):
            fallbacks.append(f"not georeferenced by ground control points: {frame}")
        elif positions:
            frame.warnings.extend(contradictions(frame, cameras, positions))
    if not isinstance(frame, WorldFrame) and method != "none" and (positions or method == "gps"):
        frame = from_gps(cameras, positions)
        if isinstance(frame, str):
            fallbacks.append(f"not georeferenced by GPS: {frame}")
    found = frame if isinstance(frame, WorldFrame) else level(cameras)
    found.warnings[:0] = fallbacks
    transform_model(model, found.similarity)
    return found


def transform_model(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Apply a similarity to the poses and points of ``model``."""
    model.transform(
        pycolmap.Sim3d(
            similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation
        )
    )


def _triangulate(
    model: pycolmap.Reconstruction, seen: Mapping[str, tuple[float, float]]
) -> Triangulated | None:
    """The point closest to the rays through pixels of photographs (name -> pixel), by least
    squares; None if fewer than two are registered or the rays are nearly parallel."""
    by_name = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    centres, rays, focal = [], [], []
    for name, pixel in sorted(seen.items()):
        if name not in by_name:
            continue
        image = by_name[name]
        camera = model.camera(image.camera_id)
        local = camera_rays(camera, np.array([pixel], np.float64))[0]
        if not np.isfinite(local).all():
            continue
        ray = image.cam_from_world().rotation.matrix().T @ local
        centres.append(image.projection_center())
        rays.append(ray / np.linalg.norm(ray))
        focal.append(pixels_per_radian(camera))
    if len(rays) < 2:
        return None
    d, c = np.array(rays), np.array(centres)
    if (d @ d.T).min() > np.cos(np.radians(MIN_RAY_ANGLE_DEG)):
        return None
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    point = np.asarray(np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, c)))
    distances = np.linalg.norm(c - point, axis=1)
    return Triangulated(point, float(np.median(distances / focal)))
