"""Evidence on a model: what ``judge`` looks at, taken from pycolmap's model and database."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipeline.sfm.judge import Evidence

# Enough pairs and matches to tell turning from moving, few enough to take no time.
PARALLAX_PAIRS = 200
PARALLAX_MATCHES = 200
PARALLAX_STRETCHES = tuple(float(v) for v in np.geomspace(0.4, 2.5, 9))


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
        geometries = _verified_pairs(model, opened)
        explained = _explained_matches(model, opened, geometries)
        parallax = _parallax(model, opened, geometries)
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
        parallax=parallax,
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


def _verified_pairs(
    model: pycolmap.Reconstruction, database: pycolmap.Database
) -> dict[tuple[int, int], NDArray[np.uint32]]:
    """Image ids -> (M, 2) verified matches, of the pairs of registered images."""
    registered = set(model.reg_image_ids())
    found = {}
    ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(ids, geometries, strict=True):
        pair = pycolmap.pair_id_to_image_pair(pair_id)
        if set(pair) <= registered and len(geometry.inlier_matches) > 0:
            found[pair] = geometry.inlier_matches
    return dict(sorted(found.items()))


def _explained_matches(
    model: pycolmap.Reconstruction,
    database: pycolmap.Database,
    pairs: dict[tuple[int, int], NDArray[np.uint32]],
) -> float:
    """Share of verified matches between registered images that join keypoints of one point."""
    seen: dict[int, NDArray[np.int64]] = {}
    for image_id in model.reg_image_ids():
        points = np.full(database.num_keypoints_for_image(image_id), -1, np.int64)
        for index, point2D in enumerate(model.image(image_id).points2D):
            if point2D.has_point3D():
                points[index] = point2D.point3D_id
        seen[image_id] = points
    explained, matches = 0, 0
    for (first, second), inliers in pairs.items():
        a, b = seen[first][inliers[:, 0]], seen[second][inliers[:, 1]]
        explained += int(((a == b) & (a >= 0)).sum())
        matches += len(inliers)
    return explained / max(matches, 1)


def _parallax(
    model: pycolmap.Reconstruction,
    database: pycolmap.Database,
    pairs: dict[tuple[int, int], NDArray[np.uint32]],
) -> float:
    """How far matches are from what a camera that only turns would see, over the longer side.

    For each pair the best rotation between the keypoints' rays is found (Kabsch) and the median
    distance of what it predicts taken; of the pairs, the third quartile. The focal length of a
    camera that only turned can be anything, so the smallest value over several is returned.
    """
    if not pairs:
        return 0.0
    chosen = list(pairs)[:: max(1, len(pairs) // PARALLAX_PAIRS)]
    planes: dict[int, tuple[NDArray[np.float64], float]] = {}
    for image_id in sorted({i for pair in chosen for i in pair}):
        camera = model.camera(model.image(image_id).camera_id)
        xy = database.read_keypoints(image_id)[:, :2].astype(np.float64)
        side = max(camera.width, camera.height)
        plane = np.asarray(camera.cam_from_img(xy), np.float64)
        planes[image_id] = plane, camera.mean_focal_length() / side
    values = []
    for stretch in PARALLAX_STRETCHES:
        residuals = []
        for first, second in chosen:
            matches = pairs[first, second][:PARALLAX_MATCHES]
            (plane_a, _), (plane_b, focal) = planes[first], planes[second]
            a, b = plane_a[matches[:, 0]] * stretch, plane_b[matches[:, 1]] * stretch
            predicted = _turn(a, b)
            misses = np.linalg.norm(predicted - b, axis=1) / stretch * focal
            residuals.append(float(np.nanmedian(misses)))
        values.append(float(np.percentile(residuals, 75)))
    return min(values)


def _turn(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M, 2) where points ``a`` of the plane z = 1 go by the rotation that best takes them to
    ``b``; NaN where that is behind."""
    rays_a, rays_b = (np.column_stack([p, np.ones(len(p))]) for p in (a, b))
    rays_a /= np.linalg.norm(rays_a, axis=1, keepdims=True)
    rays_b /= np.linalg.norm(rays_b, axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(rays_b.T @ rays_a)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    turned = rays_a @ rotation.T
    return turned[:, :2] / np.where(turned[:, 2:] > 1e-6, turned[:, 2:], np.nan)
