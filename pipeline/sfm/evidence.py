"""Statistics of a reconstruction for the quality check (``judge``), from a pycolmap model and its
database."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pycolmap
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.sfm.consistency import measure_consistency, pair_agrees
from pipeline.sfm.continuity import Names, broken_steps
from pipeline.sfm.distinctive import distinctive_pairs
from pipeline.sfm.judge import FOCAL_IMAGES, FOCAL_STEP, MAX_FOCAL_OFF, Evidence
from pipeline.sfm.model_views import Floats, ModelView, Pairs, read_views

# Size of the sample of pairs, and of matches of each, that pure rotation is fitted to.
PARALLAX_PAIRS = 40
PARALLAX_MATCHES = 64
# Grid of focal lengths (over the longer side) and radial distortions: under pure rotation the
# model's own estimates may be wrong.
PARALLAX_FOCALS = tuple(float(v) for v in np.geomspace(0.35, 4.0, 14))
PARALLAX_STEP = float(np.log(PARALLAX_FOCALS[1] / PARALLAX_FOCALS[0]))
PARALLAX_RADIALS = (-0.3, -0.15, 0.0, 0.15)

# Focal certainty: number of iterations of the bundle adjustments.
FOCAL_ITERATIONS = 8
# Focal certainty: mean number of observations per image. The relative increase of the cost hardly
# depends on it.
FOCAL_OBSERVATIONS = 500
HOMOGRAPHIES = (
    pycolmap.TwoViewGeometryConfiguration.PLANAR,
    pycolmap.TwoViewGeometryConfiguration.PANORAMIC,
    pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC,
)


def collect_evidence(
    model: pycolmap.Reconstruction,
    database: Path,
    total: int,
    steps: Sequence[Names] = (),
    original: Path | None = None,
    before: Evidence | None = None,
) -> Evidence:
    """Compute the statistics of ``model``.

    Args:
        database: The database that the model was mapped from.
        total: The number of photographs of the scene.
        steps: The result of ``sequence_steps``.
        original: The database of all pairs, which determines the distinctive ones, if pairs were
            left out of ``database``.
        before: The statistics of the model before refinement, whose ``focal_certainty`` is kept: it
            belongs to the photographs, and a refined focal length is no new evidence.
    """
    with pycolmap.Database.open(database) as opened:
        verified = every = read_verified_pairs(opened)
        views = read_views(model, opened)
        names = {image.image_id: image.name for image in opened.read_all_images()}
    if original is not None and original != database:
        with pycolmap.Database.open(original) as opened:
            every = read_verified_pairs(opened)
    pairs = {pair: m for pair, m in verified.items() if set(pair) <= set(views)}
    behind, observations, angles = _geometry(model, views)
    consistency = measure_consistency(model, views, pairs, distinctive_pairs(every))
    ids = {name: image_id for image_id, name in names.items()}

    def agrees(pair: Names) -> bool | None:
        first, second = sorted(ids[name] for name in pair)
        matches = pairs.get((first, second))
        return None if matches is None else pair_agrees(views[first], views[second], matches)

    broken = broken_steps(
        {names[i]: view.rotation for i, view in views.items()},
        agrees,
        steps,
    )
    flat = [view for view in views.values() if not view.is_panorama]
    relative = [view.focal / view.longer_side for view in flat]
    priors = focal_priors(database)
    known = [(v.focal, priors[v.camera.camera_id]) for v in flat if v.camera.camera_id in priors]
    offs = [max(focal / prior, prior / max(focal, 1e-9)) for focal, prior in known]
    focal_off = float(np.median(offs)) if offs else None
    agrees_with_exif = focal_off is not None and focal_off <= MAX_FOCAL_OFF
    if before is not None:
        certainty = before.focal_certainty
    else:
        is_unsure = not agrees_with_exif or _shows_plane(database)
        certainty = focal_certainty(model) if is_unsure and relative else None
    return Evidence(
        registered=len(views),
        total=total,
        reachable=_largest_component(list(verified)),
        points=int(model.num_points3D()),
        observations_per_image=observations / max(len(views), 1),
        mean_track_length=float(model.compute_mean_track_length()),
        reprojection_px=float(model.compute_mean_reprojection_error()),
        explained_matches=_explained_matches(views, pairs),
        **consistency._asdict(),
        pairs_left_out=len(verified) < len(every),
        broken_steps=len(broken),
        behind_camera=behind,
        parallax=_parallax(views, pairs),
        median_angle_deg=float(np.median(angles)) if len(angles) else 0.0,
        focal_off=focal_off,
        focal_certainty=certainty,
        pincushion=max((_pincushion(view) for view in flat if not view.is_wide), default=1.0),
        focal_relative=float(np.median(relative)) if relative else None,
    )


def _shows_plane(database: Path) -> bool:
    """Whether a homography explains most of the verified pairs."""
    with pycolmap.Database.open(database) as opened:
        _, geometries = opened.read_two_view_geometries()
    of_pairs = [g.config in HOMOGRAPHIES for g in geometries if len(g.inlier_matches) > 0]
    return bool(of_pairs) and 2 * sum(of_pairs) > len(of_pairs)


def _pincushion(view: ModelView) -> float:
    """The factor by which the distortion moves the middle of the image's shorter edge outwards."""
    camera = view.camera
    middle = np.array([[camera.width, camera.height]]) / 2
    edge = middle * (np.array([2, 1]) if camera.width >= camera.height else np.array([1, 2]))
    ray = np.asarray(camera.cam_from_img(edge), np.float64)
    return view.longer_side / 2 / max(float(np.linalg.norm(ray)) * view.focal, 1e-12)


def focal_priors(database: Path) -> dict[int, float]:
    """Camera id -> focal length from EXIF in pixels, for the cameras that have one."""
    with pycolmap.Database.open(database) as opened:
        return {
            camera.camera_id: float(camera.mean_focal_length())
            for camera in opened.read_all_cameras()
            if camera.has_prior_focal_length and not camera.is_spherical()
        }


def _geometry(
    model: pycolmap.Reconstruction, views: dict[int, ModelView]
) -> tuple[float, int, Floats]:
    """Share of the observations behind their camera, number of observations, and (P,) angles in
    degrees of each point: the largest between the ray of its first image and any other."""
    ids = np.array(sorted(model.point3D_ids()), np.int64)
    xyz = np.array([model.point3D(i).xyz for i in ids.tolist()]).reshape(-1, 3)
    first, is_known = np.zeros((len(ids), 3)), np.zeros(len(ids), bool)
    cosines, behind, observations = np.ones(len(ids)), 0, 0
    for view in views.values():
        seen = np.flatnonzero(view.observed >= 0)
        index = np.searchsorted(ids, view.observed[seen])
        local = xyz[index] @ view.rotation.T + view.translation
        # A wide lens sees behind its plane: the point must be along the keypoint's ray.
        depth = (local * view.rays[seen]).sum(1) if view.is_wide else local[:, 2]
        behind += int((depth <= 0).sum())
        observations += len(seen)
        rays = view.centre - xyz[index]
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        new = ~is_known[index]
        first[index[new]], is_known[index] = rays[new], True
        np.minimum.at(cosines, index, (rays * first[index]).sum(1))
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return behind / max(observations, 1), observations, angles


def read_verified_pairs(database: pycolmap.Database) -> Pairs:
    """Image ids -> (M, 2) verified matches, for the pairs that have any, sorted by ids."""
    found = {}
    ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(ids, geometries, strict=True):
        if len(geometry.inlier_matches) > 0:
            found[pycolmap.pair_id_to_image_pair(pair_id)] = geometry.inlier_matches
    return dict(sorted(found.items()))


def _largest_component(pairs: list[tuple[int, int]]) -> int:
    """Number of images in the largest connected component of the view graph."""
    if not pairs:
        return 0
    ids, index = np.unique(np.array(pairs), return_inverse=True)
    rows, columns = index.reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(ids), len(ids)))
    _, label = connected_components(graph, directed=False)
    return int(np.bincount(label).max())


def _explained_matches(views: dict[int, ModelView], pairs: Pairs) -> float:
    """Share of the verified matches whose two keypoints are observations of one 3D point."""
    explained, matches = 0, 0
    for (first, second), inliers in pairs.items():
        a, b = views[first].observed[inliers[:, 0]], views[second].observed[inliers[:, 1]]
        explained += int(((a == b) & (a >= 0)).sum())
        matches += len(inliers)
    return explained / max(matches, 1)


def _parallax(views: dict[int, ModelView], pairs: Pairs) -> float:
    """Residual of the matches under pure rotation, as a share of the longer side.

    For each pair the rotation that best aligns the keypoints' rays (Kabsch) gives a median
    distance between predicted and matched keypoints; the value is the upper quartile over the
    pairs, minimised over focal lengths and radial distortions on a grid. Panoramas have neither;
    if most pairs have one, the value is computed from the rays of all.
    """
    spheres = {image_id for image_id, view in views.items() if view.is_panorama}
    flat = {pair: matches for pair, matches in pairs.items() if not spheres & set(pair)}
    if len(flat) < len(pairs) / 2:
        return _sphere_parallax(views, pairs)
    pairs = flat
    if not pairs:
        return 0.0
    chosen = list(pairs)[:: max(1, len(pairs) // PARALLAX_PAIRS)]
    found: tuple[list[Floats], list[Floats]] = ([], [])
    for pair in chosen:
        matches = pairs[pair]
        # The same number for each pair, so that all pairs form one array; pairs with fewer matches
        # repeat some.
        sample = np.linspace(0, len(matches) - 1, PARALLAX_MATCHES).round().astype(np.intp)
        for image_id, column, side in zip(pair, matches[sample].T, found, strict=True):
            view = views[image_id]
            middle = np.array([view.camera.width, view.camera.height]) / 2
            side.append((view.xy[column] - middle) / view.longer_side)
    a, b = (np.stack(side) for side in found)

    def residual(focal: float, radial: float) -> float:
        # Normalised coordinates with one radial term removed, to first order.
        rays_a, rays_b = (
            p / focal * (1 - radial * ((p / focal) ** 2).sum(-1, keepdims=True)) for p in (a, b)
        )
        distances = np.linalg.norm(_best_rotated(rays_a, rays_b) - rays_b, axis=-1) * focal
        medians = np.median(np.nan_to_num(distances, nan=1.0), axis=1)
        return float(np.percentile(medians, 75))

    best, focal, radial = min(
        (residual(f, k), f, k) for f in PARALLAX_FOCALS for k in PARALLAX_RADIALS
    )
    for finer in (0.5, 0.25):
        near = [
            (focal * float(np.exp(sf * finer * PARALLAX_STEP)), radial + sk * finer * 0.15)
            for sf in (-1, 0, 1)
            for sk in (-1, 0, 1)
        ]
        best, focal, radial = min([(residual(f, k), f, k) for f, k in near])
    return best


def _sphere_parallax(views: dict[int, ModelView], pairs: Pairs) -> float:
    """``_parallax`` from rays: angles, as a share of the angle of ``ModelView.side``."""
    medians = []
    for first, second in list(pairs)[:: max(1, len(pairs) // PARALLAX_PAIRS)]:
        matches = pairs[first, second]
        a, b = views[first].rays[matches[:, 0]], views[second].rays[matches[:, 1]]
        good = np.isfinite(a).all(1) & np.isfinite(b).all(1)
        rotated = _rotated_onto(a[good], b[good])
        chord = np.linalg.norm(rotated - b[good], axis=1)
        angles = 2 * np.arcsin(np.clip(chord / 2, 0, 1))
        medians.append(float(np.median(angles)) if len(angles) else 0.0)
    return float(np.percentile(medians, 75)) / (np.pi / 2)


def _best_rotated(a: Floats, b: Floats) -> Floats:
    """(P, M, 2) normalized coordinates ``a`` of P pairs, rotated by the rotation of each pair that
    best aligns them with ``b``; NaN behind the camera."""
    rays_a, rays_b = (np.concatenate([p, np.ones((*p.shape[:-1], 1))], -1) for p in (a, b))
    rays_a /= np.linalg.norm(rays_a, axis=-1, keepdims=True)
    rays_b /= np.linalg.norm(rays_b, axis=-1, keepdims=True)
    rotated = _rotated_onto(rays_a, rays_b)
    depth = np.where(rotated[..., 2:] > 1e-6, rotated[..., 2:], np.nan)
    return np.asarray(rotated[..., :2] / depth)


def _rotated_onto(a: Floats, b: Floats) -> Floats:
    """(..., M, 3) unit rays ``a``, rotated by the rotation that best aligns them with ``b``
    (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(np.swapaxes(b, -1, -2) @ a)
    vt[..., 2, :] *= (np.linalg.det(u) * np.linalg.det(vt))[..., None]
    return np.asarray(a @ np.swapaxes(u @ vt, -1, -2))


def focal_certainty(model: pycolmap.Reconstruction) -> float:
    """Smallest relative increase of the robust cost if the focal lengths are held 20% smaller or
    larger while all other parameters are adjusted. Near 0, the images do not determine the focal
    length (fronto-parallel planes, pure rotation, forward motion)."""
    base = _with_fewer_points(model)
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


def _with_fewer_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with every n-th point: about ``FOCAL_OBSERVATIONS`` for each image."""
    copy = pycolmap.Reconstruction(model)
    images = max(model.num_reg_images(), 1)
    share = int(model.compute_num_observations()) / (images * FOCAL_OBSERVATIONS)
    every = math.ceil(share)
    if every > 1:
        manager = pycolmap.ObservationManager(copy)
        for number, point_id in enumerate(sorted(copy.point3D_ids())):
            if number % every:
                manager.delete_point3D(point_id)
    return copy


def _adjusted_cost(model: pycolmap.Reconstruction, *, refine_focal: bool) -> float:
    """Bundle adjust ``model`` for a few iterations, on a sample of images, and return the cost."""
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
