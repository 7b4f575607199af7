"""Optimise the Gaussians. Outputs: ``gaussians.npz``, ``curve.json`` and ``exposure.json``; and
where cameras or lenses were refined ``sparse/0``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.config.schema import Config, Split, Train, Views
from pipeline.runtime.atomic import write_json
from pipeline.runtime.job import Job
from pipeline.scene.stage import StagePlan, StageSpec
from stages.workflow.inputs import MODEL, VIEWS, input_model, read_manifest

if TYPE_CHECKING:
    from pipeline.scene.plan import Plan
    from pipeline.scene.scan import Scan
    from pipeline.scene.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    from pipeline.scene.budget import memory_line, resolution_line

    config, why = settled.config, settled.why
    minutes = config.train.budget_minutes
    decisions = [
        resolution_line(scan, config),
        why["train.density.max_gaussians"],
        why["train.background"],
        why["train.depth_weight"],
        _masks(scan, config),
        memory_line(scan, config),
    ]
    return StagePlan(
        run=True,
        reason=f"{config.train.steps} steps" if minutes is None else f"{minutes:g} minutes",
        decisions=[text for text in decisions if text],
    )


def _masks(scan: Scan, config: Config) -> str:
    if config.views.masks == "ignore":
        return "masks ignored, as configured"
    return f"masks in {scan.num_masks} photographs" if scan.num_masks else ""


def work(job: Job) -> None:
    from pipeline.scene.colmap import write_model
    from pipeline.scene.views import load_views
    from pipeline.splats.gaussians import Gaussians
    from pipeline.training.scene import train_scene

    manifest, model = read_manifest(job, "views"), input_model(job)
    trained = train_scene(
        load_views(manifest, model, job.section(Views), job.section(Split)),
        manifest,
        model,
        Gaussians.load(job.inputs["init"] / "gaussians.npz"),
        job.section(Train),
        seed=job.seed,
        threads=job.threads,
        memory_mb=job.memory_mb,
        checkpoint_dir=job.scratch / "checkpoints",
        logs=job.logs,
    )
    trained.result.gaussians.save(job.out / "gaussians.npz")
    if trained.model is not None:
        write_model(job.out / "sparse" / "0", trained.model)
    write_json(job.out / "curve.json", trained.result.curve)
    write_json(job.out / "exposure.json", trained.gains)
    job.tell(trained.decisions, trained.warnings)
    job.counters, job.timings = trained.counters, trained.timings


def memory_mb(plan: Plan) -> int:
    """The configured limit, or half more than the plan's rough estimate."""
    estimate = round(1.5 * plan.facts["training_memory_mb"])
    return plan.config.train.memory_mb or estimate


SPEC = StageSpec(
    name="train",
    work=work,
    decide=decide,
    inputs={"views": VIEWS, "model": MODEL, "init": ("init",)},
    options=("train", "views", "split"),
    packages=("torch", "numpy", "opencv-contrib-python-headless"),
    seeded=True,
    memory_mb=memory_mb,
)
