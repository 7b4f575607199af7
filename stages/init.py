"""The initial Gaussians, from fused depth maps, the scene's point cloud, sparse points or random.
Output: ``gaussians.npz``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.experiments import Experiments
from pipeline.config.settled import Features, Init, Matches, Train
from pipeline.plan.point_cloud import IN_POSES, IN_PROJECTION, PointCloudFiles
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.splats.counters import InitCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.io.posefiles import GivenPoses
    from pipeline.mvs.initial import SurfacePoints
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled
    from pipeline.scene.background import SceneBackground
    from pipeline.scene.reconstruction import Points
    from pipeline.scene.views import View

# Methods that use the point cloud of the scene folder.
EXPERIMENTS = ("experiments.init", "experiments.matches")


def decide(scan: Scan, settled: Settled) -> StagePlan:
    config = settled.config.init
    if config.method == "random":
        count = settled.config.experiments.init.num_random
        return StagePlan(run=True, reason=f"{count} random Gaussians")
    if config.method == "dense":
        limit = f"{config.max_points:,}"
        reason = f"Gaussians from the fused depth maps, subsampled to at most {limit} points"
        decisions = []
        if scan.cloud is not None:
            decisions.append(f"init.method: points would use {scan.cloud.text}")
        return StagePlan(run=True, reason=reason, decisions=decisions)
    if scan.cloud is not None:
        return _from_cloud(scan.cloud, scan.poses, config.max_points)
    if scan.poses is None:
        return StagePlan(run=True, reason="Gaussians from the sparse points of sfm")
    if count := scan.poses.num_points:
        return StagePlan(run=True, reason=f"Gaussians from the given {count} sparse points")
    points = "whose points are not used" if scan.few_views else "which have no points"
    reason = f"Gaussians from points triangulated with the given poses, {points}"
    pairs = "pairs of cameras with near positions and similar directions"
    return StagePlan(run=True, reason=reason, decisions=[pairs])


def _from_cloud(cloud: PointCloudFiles, poses: GivenPoses | None, max_points: int) -> StagePlan:
    reason = f"Gaussians from {cloud.text}, subsampled to at most {max_points:,} that a view sees"
    frame = IN_PROJECTION if poses is None else IN_POSES
    decisions = [f"the point cloud is taken to be in {frame} (init.points_file: none ignores it)"]
    if poses is None or poses.num_points:
        decisions.append("sparse points are still used for depths and exposures")
    return StagePlan(run=True, reason=reason, decisions=decisions)


def work(job: Job) -> None:
    from pipeline.io.arrays import write_arrays
    from pipeline.io.clouds.stored import read_cloud
    from pipeline.io.colmap import read_model
    from pipeline.photos.cloud import NOT_PLACED, placed_points
    from pipeline.sfm.triangulation import TriangulationOptions, triangulate
    from pipeline.splats.first import InitPoints, first_gaussians

    config, experiments = job.section(Init), job.section(Experiments)
    training = inputs.training_views(job)
    points = sparse = inputs.input_model(job).points
    extra, source, normals = {}, "points", None
    dense = _dense_points(job, points, training, config) if config.method == "dense" else None
    cloud = read_cloud(job.inputs["inspect"]) if config.method == "points" else None
    placed = None
    if cloud is not None:
        placed = placed_points(cloud, inputs.georeference(job), training, config)
        if placed is None:
            job.warn(NOT_PLACED)
    if dense is not None:
        points, normals, source = dense.points, dense.normals, "the depth maps"
    elif placed is not None:
        points, source = placed, "the point cloud"
    elif config.method != "random" and len(points) == 0:
        job.decide("there are no given points: points are triangulated")
        triangulated = job.scratch / "triangulation"
        sections = job.section(Features), job.section(Matches)
        manifest = inputs.read_manifest(job, "views")
        if any(view.has_listed_split for view in training):
            manifest = manifest.only({view.name for view in training})
            job.decide("test views are not used for points")
        report = triangulate(
            manifest,
            job.inputs["model"] / "sparse" / "0",
            triangulated,
            TriangulationOptions(*sections, job.seed, experiments.matches),
            threads=job.threads,
        )
        job.add_messages(report.decisions, report.warnings)
        points = read_model(triangulated).points
        extra = {"triangulated_points": len(points)}
    background = _background(job, training, sparse if len(sparse) else points)
    job.decide(background.reason)
    background.write(job.out)
    first = first_gaussians(
        InitPoints(points, source, normals),
        training,
        config,
        experiments.init,
        job.seed,
        background=background.background,
    )
    write_arrays(job.out / "gaussians.npz", first.gaussians.arrays())
    job.record(first.counters.model_copy(update=extra), first.decisions, first.warnings)


def _background(job: Job, training: list[View], points: Points) -> SceneBackground:
    import numpy as np

    from pipeline.geometry.up_direction import up_direction
    from pipeline.photos.backdrop import choose_background, measure_evidence
    from pipeline.scene.background import SceneBackground

    configured = job.section(Train).background
    if configured != "measured":
        return SceneBackground(background=configured, reason=f"{configured} background")
    photos = inputs.read_manifest(job, "views").photos
    orientations = {photo.name: photo.orientation for photo in photos}
    up = up_direction(
        np.stack([view.world_to_camera[:3, :3] for view in training]),
        [orientations[view.name] for view in training],
    )
    return choose_background(measure_evidence(training, points.xyz, up))


def _dense_points(
    job: Job, sparse: Points, training: list[View], config: Init
) -> SurfacePoints | None:
    """Points of the fused depth maps; None, with a warning, if there are too few."""
    from pipeline.mvs.initial import surface_points
    from pipeline.mvs.maps import read_dense_cloud
    from pipeline.splats.first import MIN_POINTS

    cloud = read_dense_cloud(job.inputs["dense"])
    if len(cloud) < MIN_POINTS:
        job.warn(
            f"the depth maps have only {len(cloud)} points in common: Gaussians are initialised "
            "from the sparse points"
        )
        return None
    found = surface_points(cloud, sparse, training, config.max_points)
    if found.num_sparse:
        job.decide(f"{found.num_sparse} sparse points fill holes of the depth maps")
    return found


SPEC = StageSpec(
    name="init",
    work=work,
    decide=decide,
    counters=InitCounters,
    inputs={
        "views": inputs.VIEWS,
        "model": inputs.MODEL,
        "poses": inputs.POSES,
        "inspect": ("inspect",),
        "dense": ("dense",),
    },
    only_if={"dense": lambda config: config.init.method == "dense"},
    options=("init", "train.background", "views", "split", "features", "matches", *EXPERIMENTS),
    packages=("pycolmap", "scipy", "opencv-contrib-python-headless"),
    seeded=True,
)
