"""Triangulate sparse points for cameras with known poses."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import settled
from pipeline.config.experiments import DEFAULT, MatchesExperiments
from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import run_isolated
from pipeline.scene.manifest import Manifest, Photo
from pipeline.sfm.keypoints import keypoint_file


@dataclass(frozen=True)
class TriangulatedPoints:
    """Measures of the triangulated points.

    Attributes:
        num_points, mean_reprojection_error_px, mean_track_length: of the points; 0 without any.
        num_pairs, num_verified: numbers of matched and of verified pairs.
        num_images: number of photographs with a pose.
    """

    num_points: int
    mean_reprojection_error_px: float
    mean_track_length: float
    num_pairs: int
    num_verified: int
    num_images: int


@dataclass(frozen=True)
class TriangulationReport(TriangulatedPoints):
    """Result of ``triangulate``. ``decisions`` and ``warnings`` are sentences for the log."""

    decisions: list[str]
    warnings: list[str]


def triangulate(
    manifest: Manifest,
    sparse: Path,
    out: Path,
    features: settled.Features,
    matches: settled.Matches,
    *,
    threads: int,
    seed: int,
    cache: Path | None = None,
    experiments: MatchesExperiments = DEFAULT.matches,
) -> TriangulationReport:
    """Triangulate points with the known poses of a COLMAP model and write the model to
    ``out/sparse/0``.

    Poses are unchanged; points of the model are replaced. pycolmap and cv2 run in separate
    processes, so the caller may use torch. The files do not depend on ``threads``. A result without
    points is not an error.

    Args:
        sparse: folder of a COLMAP model. Images that are not in the manifest (by name) are left
            out. Cameras of another size than their photographs are rescaled to the photographs.
        matches: options of matching; pairs are chosen by the distance of the cameras
            (``proximity_pairs``), not by ``pairs``.
        cache: folder for features that outlives the call; None for a temporary one.

    Raises:
        UserError: no image of the model is among the photographs.
    """
    with tempfile.TemporaryDirectory(prefix="splatmake-triangulation-") as folder:
        found = Path(folder) / "features"
        cache = cache or Path(folder) / "cache"
        feature_warnings = run_isolated(_extract, manifest, features, found, cache, threads)
        points = run_isolated(
            _triangulate, manifest, sparse, out, found, matches, experiments, seed
        )
    return TriangulationReport(
        **vars(points),
        decisions=[
            f"{points.num_points} points triangulated from {points.num_verified} verified of "
            f"{points.num_pairs} pairs of neighbouring cameras"
        ],
        warnings=feature_warnings,
    )


def _extract(
    manifest: Manifest, config: settled.Features, out: Path, cache: Path, threads: int
) -> list[str]:
    from pipeline.sfm.features import extract_features

    return extract_features(manifest, config, out, cache=cache, threads=threads).warnings


def _triangulate(
    manifest: Manifest,
    sparse: Path,
    out: Path,
    features: Path,
    config: settled.Matches,
    experiments: MatchesExperiments,
    seed: int,
) -> TriangulatedPoints:
    import pycolmap

    from pipeline.sfm.database import MatchingSettings, build_database, verified_inliers
    from pipeline.sfm.models import color_points, posed_model, read_colors, write_model
    from pipeline.sfm.pairs import proximity_pairs
    from pipeline.sfm.quiet import quiet_colmap

    quiet_colmap()
    model = pycolmap.Reconstruction(sparse)
    photos = {photo.name: photo for photo in manifest.photos}
    ids = sorted(i for i in model.reg_image_ids() if model.image(i).name in photos)
    if not ids:
        raise UserError(
            "no image of the given model is among the photographs",
            file=sparse,
            fix="rename the photographs to the names in the model",
        )
    cameras = {}
    for image_id in ids:
        image = model.image(image_id)
        cameras[image.camera_id] = _rescaled_to(photos[image.name], model.camera(image.camera_id))
    images = [(i, model.image(i).name, model.image(i).camera_id) for i in ids]
    poses = [model.image(i).cam_from_world() for i in ids]
    pairs = proximity_pairs(
        np.array([model.image(i).projection_center() for i in ids]),
        np.array([pose.rotation.matrix()[2] for pose in poses]),
        config.neighbours,
    )
    with tempfile.TemporaryDirectory(prefix="splatmake-triangulation-") as folder:
        database = Path(folder) / "database.db"
        build_database(
            database,
            [cameras[i] for i in sorted(cameras)],
            images,
            features,
            pairs,
            MatchingSettings(experiments.max_ratio, experiments.min_inliers, seed),
        )
        verified = verified_inliers(database)
        points = posed_model(list(cameras.values()), images, poses)
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed)
        options.extract_colors = False
        options.triangulation.ignore_two_view_tracks = False
        if verified:
            points = pycolmap.triangulate_points(
                points, database, folder, folder, clear_points=True, options=options
            )
    names = {image_id: name for image_id, name, _ in images}
    color_points(points, read_colors({i: keypoint_file(features, names[i]) for i in ids}))
    num_points = int(points.num_points3D())
    write_model(points, out / "sparse" / "0")
    return TriangulatedPoints(
        num_points=num_points,
        mean_reprojection_error_px=(
            float(points.compute_mean_reprojection_error()) if num_points else 0.0
        ),
        mean_track_length=float(points.compute_mean_track_length()) if num_points else 0.0,
        num_pairs=len(pairs),
        num_verified=len(verified),
        num_images=len(ids),
    )


def _rescaled_to(photo: Photo, camera: Any) -> Any:
    """The camera rescaled to the size of the photograph, whose pixels keypoints refer to."""
    import pycolmap

    sized = pycolmap.Camera(camera.todict())
    if (sized.width, sized.height) != (photo.width, photo.height):
        sized.rescale(photo.width, photo.height)
    sized.has_prior_focal_length = True
    return sized
