"""A model's frame, found and applied: what ``georeference`` computes, in pycolmap's hands."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.geometry.similarity import Similarity
from pipeline.geometry.up_direction import up_direction
from pipeline.io.gcp import GCP_FILE, read_ground_control
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.sfm.georeference import Cameras, Frame, from_gcp, from_gps, level

Georeference = Literal["auto", "gps", "gcp", "none"]

# Rays that meet at less than this angle say too little about where.
MIN_RAY_ANGLE_DEG = 1.0


def place(
    model: pycolmap.Reconstruction, manifest: Manifest, wanted: Georeference, control: Path | None
) -> Frame:
    """Move ``model`` to the best frame there is and return it.

    Args:
        wanted: "auto" takes ground control points, else GPS, else a level frame; "gcp" and "gps"
            warn where they must fall back, "none" does not look.
        control: the scene's ``gcp_list.txt``, None without one.

    Raises:
        UserError: a malformed ``gcp_list.txt``; "gcp" without one.
    """
    photos = {photo.name: photo for photo in manifest.photos}
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    rotations = np.stack([image.cam_from_world().rotation.matrix() for image in images])
    cameras = Cameras(
        names=[image.name for image in images],
        centres=np.stack([image.projection_center() for image in images]),
        up=up_direction(rotations, [photos[image.name].orientation for image in images]),
    )
    refused: list[str] = []
    frame: Frame | str | None = None
    if wanted == "gcp" and control is None:
        raise UserError(
            "sfm.georeference is gcp, but there are no ground control points",
            file=GCP_FILE,
            fix="put the file into the scene folder, or set sfm.georeference: auto",
        )
    if wanted in ("auto", "gcp") and control is not None:
        points = read_ground_control(control, photos)
        frame = from_gcp(points, partial(_triangulate, model))
        if isinstance(frame, str):
            refused.append(f"not georeferenced by ground control points: {frame}")
    positions = {name: photo.gps for name, photo in photos.items() if photo.gps is not None}
    if not isinstance(frame, Frame) and wanted != "none" and (positions or wanted == "gps"):
        frame = from_gps(cameras, positions)
        if isinstance(frame, str):
            refused.append(f"not georeferenced by GPS: {frame}")
    found = frame if isinstance(frame, Frame) else level(cameras)
    found.warnings[:0] = refused
    apply(model, found.similarity)
    return found


def apply(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    model.transform(
        pycolmap.Sim3d(
            similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation
        )
    )


def _triangulate(
    model: pycolmap.Reconstruction, seen: dict[str, tuple[float, float]]
) -> NDArray[np.float64] | None:
    """(3,) nearest to the rays through the photographs' pixels."""
    by_name = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    centres, rays = [], []
    for name, pixel in sorted(seen.items()):
        if name not in by_name:
            continue
        image = by_name[name]
        plane = model.camera(image.camera_id).cam_from_img(np.array(pixel, np.float64))
        if plane is None:
            continue
        ray = image.cam_from_world().rotation.matrix().T @ np.append(plane, 1.0)
        centres.append(image.projection_center())
        rays.append(ray / np.linalg.norm(ray))
    if len(rays) < 2:
        return None
    d, c = np.array(rays), np.array(centres)
    if (d @ d.T).min() > np.cos(np.radians(MIN_RAY_ANGLE_DEG)):
        return None
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    return np.asarray(np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, c)))
