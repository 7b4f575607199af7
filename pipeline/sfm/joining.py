"""Two models of one scene as one: the poses and points of the second in the world of the first."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pycolmap

from pipeline.sfm.joints import Joint
from pipeline.sfm.mappers import with_fisheye_priors
from pipeline.sfm.refine import bundle_adjust

# Rounds of completing and merging tracks, adjustment, and removal of points with large errors.
ROUNDS = 2


def join_models(
    first: pycolmap.Reconstruction, second: pycolmap.Reconstruction, joint: Joint, database: Path
) -> pycolmap.Reconstruction:
    """The photographs of both models in the world of the first, adjusted together.

    Tracks are continued across the joint by the verified matches. A photograph or a camera that
    both models have is that of the first. Runs on one thread.

    Args:
        database: The database that the first model was mapped from; not changed.
    """
    s = joint.similarity
    sim = pycolmap.Sim3d(s.scale, pycolmap.Rotation3d(s.rotation), s.translation)
    moved = pycolmap.Reconstruction(second)
    moved.transform(sim)
    model = pycolmap.Reconstruction(first)
    registered = set(first.reg_image_ids())
    added = sorted(set(second.reg_image_ids()) - registered)
    with (
        tempfile.TemporaryDirectory(dir=database.parent) as folder,
        pycolmap.Database.open(with_fisheye_priors(database, Path(folder))) as opened,
    ):
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions())
    cameras = set(model.cameras)
    model.load(cache)
    for image_id in added:
        image, old = model.image(image_id), moved.image(image_id)
        camera = moved.camera(old.camera_id)
        if image.camera_id not in cameras and camera.model == model.camera(image.camera_id).model:
            model.camera(image.camera_id).params = camera.params.tolist()
            cameras.add(image.camera_id)
        frame = model.frame(image.frame_id)
        frame.set_cam_from_world(image.camera_id, old.cam_from_world())
        model.register_frame(image.frame_id)
    _add_points(model, moved, set(added))
    _connect(model, cache)
    return model


def _add_points(
    model: pycolmap.Reconstruction, other: pycolmap.Reconstruction, images: set[int]
) -> None:
    """Add the points of another model in the same world, with their observations in ``images``."""
    for point_id in sorted(other.point3D_ids()):
        point = other.point3D(point_id)
        seen = [
            pycolmap.TrackElement(element.image_id, element.point2D_idx)
            for element in point.track.elements
            if element.image_id in images
        ]
        if len(seen) >= 2:
            model.add_point3D(point.xyz, pycolmap.Track(seen))


def _connect(model: pycolmap.Reconstruction, cache: pycolmap.DatabaseCache) -> None:
    """Triangulate across the joint and adjust the model, in place."""
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0)
    options.triangulation.ignore_two_view_tracks = False
    mapper_options, triangulation = options.get_mapper(), options.get_triangulation()
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    for image_id in sorted(model.reg_image_ids()):
        mapper.triangulate_image(triangulation, image_id)
    for _ in range(ROUNDS):
        mapper.complete_and_merge_tracks(triangulation)
        mapper.retriangulate(triangulation)
        bundle_adjust(model)
        mapper.filter_points(mapper_options)
    mapper.end_reconstruction(False)
    model.tear_down()
    model.update_point_3d_errors()
