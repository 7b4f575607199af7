"""Evidence on a model: what ``judge`` looks at, taken from pycolmap's model and database."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.sfm.consistency import Pairs, check
from pipeline.sfm.judge import MAX_FOCAL_OFF, Evidence

# Enough pairs and matches to tell turning from moving, few enough to take no time.
PARALLAX_PAIRS = 40
PARALLAX_MATCHES = 64
# A camera that only turned can have any focal length (over the longer side) and any distortion.
PARALLAX_FOCALS = tuple(float(v) for v in np.geomspace(0.35, 4.0, 14))
PARALLAX_STEP = float(np.log(PARALLAX_FOCALS[1] / PARALLAX_FOCALS[0]))
PARALLAX_RADIALS = (-0.3, -0.15, 0.0, 0.15)

# How the focal length is tried: changed by this factor, on this many images, spread evenly.
FOCAL_STEP, FOCAL_IMAGES, FOCAL_ITERATIONS = 1.2, 30, 8


def gather(model: pycolmap.Reconstruction, database: Path, total: int) -> Evidence:
    """The evidence on ``model``, which was made from ``database``, of ``total`` photographs."""
    registered = sorted(model.reg_image_ids())
    behind, observations, angles = _geometry(model)
    camera_of = {i: model.image(i).camera_id for i in registered}
    used = set(camera_of.values())
    priors = {}
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            if camera.has_prior_focal_length and camera.camera_id in used:
                priors[camera.camera_id] = float(camera.mean_focal_length())
        every = _verified_pairs(opened)
        geometries = {pair: m for pair, m in every.items() if set(pair) <= set(registered)}
        explained = _explained_matches(model, opened, geometries)
        parallax = _parallax(model, opened, geometries)
        consistency = check(model, opened, geometries)
    focal = {i: float(model.camera(i).mean_focal_length()) for i in used}
    side = {i: max(model.camera(i).width, model.camera(i).height) for i in used}
    off = {i: max(focal[i] / prior, prior / max(focal[i], 1e-9)) for i, prior in priors.items()}
    offs = [off[camera_id] for camera_id in camera_of.values() if camera_id in off]
    focal_off = float(np.median(offs)) if offs else None
    return Evidence(
        registered=len(registered),
        total=total,
        reachable=_largest_set(list(every)),
        points=int(model.num_points3D()),
        observations_per_image=observations / max(len(registered), 1),
        mean_track_length=float(model.compute_mean_track_length()),
        reprojection_px=float(model.compute_mean_reprojection_error()),
        explained_matches=explained,
        agreeing_matches=consistency.agreeing_matches,
        agreeing_pairs=consistency.agreeing_pairs,
        strangers=consistency.strangers,
        behind_camera=behind,
        parallax=parallax,
        median_angle_deg=float(np.median(angles)) if len(angles) else 0.0,
        focal_off=focal_off,
        # Where EXIF agrees nobody asks.
        focal_certainty=None if _agrees(focal_off) else _focal_certainty(model),
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


def _verified_pairs(database: pycolmap.Database) -> Pairs:
    """Image ids -> (M, 2) verified matches, of the pairs that have any, in order."""
    found = {}
    ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(ids, geometries, strict=True):
        if len(geometry.inlier_matches) > 0:
            found[pycolmap.pair_id_to_image_pair(pair_id)] = geometry.inlier_matches
    return dict(sorted(found.items()))


def _largest_set(pairs: list[tuple[int, int]]) -> int:
    """Images in the largest set that the pairs hold together."""
    if not pairs:
        return 0
    ids, index = np.unique(np.array(pairs), return_inverse=True)
    rows, columns = index.reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(ids), len(ids)))
    _, label = connected_components(graph, directed=False)
    return int(np.bincount(label).max())


def _explained_matches(
    model: pycolmap.Reconstruction,
    database: pycolmap.Database,
    pairs: Pairs,
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


def _parallax(model: pycolmap.Reconstruction, database: pycolmap.Database, pairs: Pairs) -> float:
    """How far matches are from what a camera that only turns would see, over the longer side.

    For each pair the best rotation between the keypoints' rays is found (Kabsch) and the median
    distance of what it predicts taken; of the pairs, the third quartile. The model's own focal
    length and distortion may be wrong: the smallest value over many is returned.
    """
    if not pairs:
        return 0.0
    chosen = list(pairs)[:: max(1, len(pairs) // PARALLAX_PAIRS)]
    found: tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]] = ([], [])
    for pair in chosen:
        matches = pairs[pair]
        # As many of each pair, so that all pairs make one array; of a small one some twice.
        spread = np.linspace(0, len(matches) - 1, PARALLAX_MATCHES).round().astype(np.intp)
        for image_id, column, side in zip(pair, matches[spread].T, found, strict=True):
            camera = model.camera(model.image(image_id).camera_id)
            xy = database.read_keypoints(image_id)[column, :2].astype(np.float64)
            middle = np.array([camera.width, camera.height]) / 2
            side.append((xy - middle) / max(camera.width, camera.height))
    a, b = (np.stack(side) for side in found)

    def missed(focal: float, radial: float) -> float:
        plane_a, plane_b = (_undistorted(p / focal, radial) for p in (a, b))
        misses = np.linalg.norm(_turn(plane_a, plane_b) - plane_b, axis=-1) * focal
        medians = np.median(np.nan_to_num(misses, nan=1.0), axis=1)
        return float(np.percentile(medians, 75))

    best, focal, radial = min(
        (missed(f, k), f, k) for f in PARALLAX_FOCALS for k in PARALLAX_RADIALS
    )
    for finer in (0.5, 0.25):
        near = [
            (focal * float(np.exp(sf * finer * PARALLAX_STEP)), radial + sk * finer * 0.15)
            for sf in (-1, 0, 1)
            for sk in (-1, 0, 1)
        ]
        best, focal, radial = min([(missed(f, k), f, k) for f, k in near])
    return best


def _undistorted(plane: NDArray[np.float64], radial: float) -> NDArray[np.float64]:
    """(..., 2) without a radial term, to first order: this is to be near, not exact."""
    return plane * (1 - radial * (plane**2).sum(-1, keepdims=True))


def _turn(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, M, 2) where points ``a`` of the plane z = 1 go by the rotation, one for each of P, that
    best takes them to ``b``; NaN where that is behind."""
    rays_a, rays_b = (np.concatenate([p, np.ones((*p.shape[:-1], 1))], -1) for p in (a, b))
    rays_a /= np.linalg.norm(rays_a, axis=-1, keepdims=True)
    rays_b /= np.linalg.norm(rays_b, axis=-1, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(rays_b, -1, -2) @ rays_a)
    vt[:, 2] *= (np.linalg.det(u) * np.linalg.det(vt))[:, None]
    turned = rays_a @ np.swapaxes(u @ vt, -1, -2)
    return np.asarray(turned[..., :2] / np.where(turned[..., 2:] > 1e-6, turned[..., 2:], np.nan))


def _agrees(focal_off: float | None) -> bool:
    return focal_off is not None and focal_off <= MAX_FOCAL_OFF


def _focal_certainty(model: pycolmap.Reconstruction) -> float:
    """By what share the robust cost rises, at least, when the focal lengths are 20% smaller or
    larger and everything else may adapt: near 0, the photographs do not tell them (a plane seen
    from the front, a camera that turns or goes straight ahead)."""
    base = pycolmap.Reconstruction(model)
    best = _adjusted_cost(base, refine_focal=True)
    rises = []
    for factor in (1 / FOCAL_STEP, FOCAL_STEP):
        trial = pycolmap.Reconstruction(base)
        for camera in trial.cameras.values():
            params = np.array(camera.params)
            params[list(camera.focal_length_idxs())] *= factor
            camera.params = params
        rises.append(_adjusted_cost(trial, refine_focal=False) / max(best, 1e-12) - 1)
    return max(float(min(rises)), 0.0)


def _adjusted_cost(model: pycolmap.Reconstruction, *, refine_focal: bool) -> float:
    """Adjust ``model`` and return its robust cost; a few steps, for the order of magnitude."""
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=refine_focal, print_summary=False
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = FOCAL_ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-4
    config = pycolmap.BundleAdjustmentConfig()
    images = sorted(model.reg_image_ids())
    for image_id in images[:: -(-len(images) // FOCAL_IMAGES)]:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    summary = cast(pycolmap.CeresBundleAdjustmentSummary, adjuster.solve())
    return float(summary.ceres_summary.final_cost)
