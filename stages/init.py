"""The initial Gaussians, from sparse points or random. Output: ``gaussians.npz``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.experiments import Experiments
from pipeline.config.schema import Features, Init, Matches
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.splats.counters import InitCounters
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled

EXPERIMENTS = ("experiments.init", "experiments.matches")


def decide(scan: Scan, settled: Settled) -> StagePlan:
    config = settled.config.init
    if config.method == "random":
        count = settled.config.experiments.init.num_random
        return StagePlan(run=True, reason=f"{count} random Gaussians")
    if scan.poses is None:
        return StagePlan(run=True, reason="Gaussians from the sparse points of sfm")
    if count := scan.poses.num_points:
        return StagePlan(run=True, reason=f"Gaussians from the given {count} sparse points")
    reason = "Gaussians from points triangulated with the given poses, which have no points"
    pairs = "pairs of cameras with near positions and similar directions"
    return StagePlan(run=True, reason=reason, decisions=[pairs])


def work(job: Job) -> None:
    from pipeline.io.arrays import write_arrays
    from pipeline.io.colmap import read_model
    from pipeline.sfm.triangulation import triangulate
    from pipeline.splats.first import first_gaussians

    config, experiments = job.section(Init), job.section(Experiments)
    training = inputs.training_views(job)
    points = inputs.input_model(job).points
    extra = {}
    if config.method != "random" and len(points) == 0:
        job.decide("the given poses have no points: points are triangulated")
        triangulated = job.scratch / "triangulation"
        report = triangulate(
            inputs.read_manifest(job, "views"),
            job.inputs["model"] / "sparse" / "0",
            triangulated,
            job.section(Features),
            job.section(Matches),
            threads=job.threads,
            seed=job.seed,
            experiments=experiments.matches,
        )
        job.add_messages(report.decisions, report.warnings)
        points = read_model(triangulated / "sparse" / "0").points
        extra = {"triangulated_points": len(points)}
    first = first_gaussians(points, training, config, experiments.init, job.seed)
    write_arrays(job.out / "gaussians.npz", first.gaussians.arrays())
    job.record(first.counters.model_copy(update=extra), first.decisions, first.warnings)


SPEC = StageSpec(
    name="init",
    work=work,
    decide=decide,
    counters=InitCounters,
    inputs={"views": inputs.VIEWS, "model": inputs.MODEL},
    options=("init", "views", "split", "features", "matches", *EXPERIMENTS),
    packages=("pycolmap", "scipy", "opencv-contrib-python-headless"),
    seeded=True,
    memory_mb=3000,
)
