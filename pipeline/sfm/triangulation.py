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


@dataclass(frozen=True)
class TriangulationOptions:
    """How points are triangulated.

    Attributes:
        features: The options of the features stage.
        matches: The options of matching. Pairs are chosen by the distance of the cameras
            (``proximity_pairs``), not by ``pairs``.
        seed: The seed of RANSAC and of the triangulation.
    """

    features: settled.Features
    matches: settled.Matches
    seed: int
    experiments: MatchesExperiments = DEFAULT.matches


@dataclass(frozen=True)
class TriangulationReport:
    """Result of ``triangulate``.

    Attributes:
        num_points: The number of triangulated points.
        num_images: The number of photographs with a pose.
        decisions, warnings: The sentences for the log.
    """

    num_points: int
    num_images: int
    decisions: list[str]
    warnings: list[str]


def triangulate(
    manifest: Manifest,
    sparse: Path,
    target: Path,
    options: TriangulationOptions,
    *,
    threads: int,
) -> TriangulationReport:
    """Triangulate points with the known poses of a COLMAP model and write the model to ``target``.

    Poses are unchanged; points of the model are replaced. pycolmap and cv2 run in separate
    processes, so the caller may use torch. The files do not depend on ``threads``. A result without
    points is not an error.

    Args:
        sparse: The folder of a COLMAP model. Images that are not in the manifest (by name) are left
            out. Cameras of another size than their photographs are rescaled to the photographs.

    Raises:
        UserError: No image of the model is among the photographs.
    """
    with tempfile.TemporaryDirectory(prefix="splatmake-triangulation-") as folder:
        work = Path(folder)
        warnings = run_isolated(_extract, manifest, options.features, work, threads)
        return run_isolated(_triangulate, manifest, sparse, target, work, options, warnings)


def _extract(manifest: Manifest, config: settled.Features, work: Path, threads: int) -> list[str]:
    from pipeline.sfm.features import extract_features

    cache, out = work / "cache", work / "features"
    return extract_features(manifest, config, out, cache=cache, threads=threads).warnings


def _triangulate(
    manifest: Manifest,
    sparse: Path,
    target: Path,
    work: Path,
    options: TriangulationOptions,
    warnings: list[str],
) -> TriangulationReport:
    import pycolmap

    from pipeline.sfm.database import MatchingInputs, build_database, verified_inliers
    from pipeline.sfm.models import color_points, posed_model, quiet_colmap, write_model
    from pipeline.sfm.pairs import proximity_pairs

    quiet_colmap()
    model = pycolmap.Reconstruction(sparse)
    photos = {photo.name: photo for photo in manifest.photos}
    images = [model.image(i) for i in sorted(model.reg_image_ids())]
    images = [image for image in images if image.name in photos]
    if not images:
        raise UserError(
            "no image of the given model is among the photographs",
            file=sparse,
            fix="rename the photographs to the names in the model",
        )
    cameras = {
        image.camera_id: _rescaled_to(photos[image.name], model.camera(image.camera_id))
        for image in images
    }
    poses = [image.cam_from_world() for image in images]
    pairs = proximity_pairs(
        np.array([image.projection_center() for image in images]),
        np.array([pose.rotation.matrix()[2] for pose in poses]),
        options.matches.neighbours,
    )
    inputs = MatchingInputs(
        [cameras[i] for i in sorted(cameras)],
        [(image.image_id, image.name, image.camera_id) for image in images],
        work / "features",
        options.experiments.max_ratio,
        options.experiments.min_inliers,
        options.seed,
    )
    database = work / "database.db"
    build_database(database, inputs, pairs)
    verified = verified_inliers(database)
    points = posed_model(list(cameras.values()), inputs.images, poses)
    pipeline = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=options.seed)
    pipeline.extract_colors = False
    pipeline.triangulation.ignore_two_view_tracks = False
    if verified:
        points = pycolmap.triangulate_points(
            points, database, work, work, clear_points=True, options=pipeline
        )
    color_points(points, dict(inputs.colors()))
    write_model(points, target)
    count = int(points.num_points3D())
    decision = (
        f"{count} points triangulated from {len(verified)} verified of {len(pairs)} pairs of "
        "neighbouring cameras"
    )
    return TriangulationReport(count, len(images), [decision], warnings)


def _rescaled_to(photo: Photo, camera: Any) -> Any:
    """The camera rescaled to the size of the photograph, whose pixels keypoints refer to."""
    from pipeline.sfm.models import with_prior

    sized = with_prior(camera)
    if (sized.width, sized.height) != (photo.width, photo.height):
        sized.rescale(photo.width, photo.height)
    return sized
