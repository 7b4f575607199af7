"""Evidence on a model: what ``judge`` looks at, taken from pycolmap's model and database."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.judge import Evidence


def gather(model: pycolmap.Reconstruction, database: Path, total: int) -> Evidence:
    """The evidence on ``model``, which was made from ``database``."""
    registered = sorted(model.reg_image_ids())
    behind, observations, angles = _geometry(model)
    camera_of = {i: model.image(i).camera_id for i in registered}
    used = set(camera_of.values())
    priors = {}
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            if camera.has_prior_focal_length and camera.camera_id in used:
                priors[camera.camera_id] = float(camera.mean_focal_length())
        explained = _explained_matches(model, opened)
    focal = {i: float(model.camera(i).mean_focal_length()) for i in used}
    side = {i: max(model.camera(i).width, model.camera(i).height) for i in used}
    off = {i: max(focal[i] / prior, prior / max(focal[i], 1e-9)) for i, prior in priors.items()}
    offs = [off[camera_id] for camera_id in camera_of.values() if camera_id in off]
    return Evidence(
        registered=len(registered),
        total=total,
        points=int(model.num_points3D()),
        observations_per_image=observations / max(len(registered), 1),
        mean_track_length=float(model.compute_mean_track_length()),
        reprojection_px=float(model.compute_mean_reprojection_error()),
        explained_matches=explained,
        behind_camera=behind,
        median_angle_deg=float(np.median(angles)) if len(angles) else 0.0,
        focal_off=float(np.median(offs)) if offs else None,
        focal_relative=float(np.median([focal[c] / side[c] for c in camera_of.values()])),
        focal_prior_px=priors,
    )


def _geometry(model: pycolmap.Reconstruction) -> tuple[float, int, NDArray[np.float64]]:
    """Share of observations behind their camera, their number, and each point's angle (degrees)
    between the rays of its first camera and of the one farthest from that."""
    poses = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        poses[image_id] = (image.cam_from_world().matrix()[2], image.projection_center())
    behind, observations = 0, 0
    angles = np.zeros(model.num_points3D())
    for place, point in enumerate(model.points3D.values()):
        seen = [poses[element.image_id] for element in point.track.elements]
        axes, centres = (np.array(column) for column in zip(*seen, strict=True))
        behind += int((axes[:, :3] @ point.xyz + axes[:, 3] <= 0).sum())
        observations += len(seen)
        rays = centres - point.xyz
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles[place] = np.degrees(np.arccos(np.clip((rays @ rays[0]).min(), -1, 1)))
    return behind / max(observations, 1), observations, angles


def _explained_matches(model: pycolmap.Reconstruction, database: pycolmap.Database) -> float:
    """Share of verified matches between registered images that join keypoints of one point."""
    seen: dict[int, NDArray[np.int64]] = {}
    for image_id in model.reg_image_ids():
        points = np.full(database.num_keypoints_for_image(image_id), -1, np.int64)
        for index, point2D in enumerate(model.image(image_id).points2D):
            if point2D.has_point3D():
                points[index] = point2D.point3D_id
        seen[image_id] = points
    explained, matches = 0, 0
    ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(ids, geometries, strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        inliers = geometry.inlier_matches
        if first not in seen or second not in seen or len(inliers) == 0:
            continue
        a, b = seen[first][inliers[:, 0]], seen[second][inliers[:, 1]]
        explained += int(((a == b) & (a >= 0)).sum())
        matches += len(inliers)
    return explained / max(matches, 1)
