"""Compare renders of the test views with their photographs, and estimated poses with ground truth
(``sparse_gt``) if there is any. Outputs: ``evaluation.json`` with ``renders/``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.config.schema import Evaluate, Split
from pipeline.metrics.counters import EvaluateCounters
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import Plan, StagePlan
from pipeline.runtime.job import Job
from stages.workflow import inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled

# With refined cameras, the poses of test views are fitted to their photographs before measuring.
FIT_OPTIONS = ("train.refine_poses", "train.ssim_loss_weight")


def decide(scan: Scan, settled: Settled) -> StagePlan:
    every = settled.config.split.test_every
    truth = ["pose errors with respect to sparse_gt/"] if scan.truth is not None else []
    reason = f"one view in {every}, sorted by name, is a test view"
    if scan.num_test:
        reason = f"{scan.num_test} test views"
        reason += "" if scan.few_views else ": the split that the given poses list"
    elif every == 0:
        reason = "no test views: measured on the training views"
    published = [settled.why["split.source"]] if settled.why["split.source"] else []
    return StagePlan(run=True, reason=reason, decisions=[*published, *truth])


def work(job: Job) -> None:
    from pipeline.io.appearance_files import read_appearance
    from pipeline.io.colmap import read_model
    from pipeline.metrics.evaluate import evaluate_views
    from pipeline.metrics.pose import pose_error
    from pipeline.metrics.protocol import choose_protocol
    from pipeline.metrics.published import against_published
    from pipeline.render.registry import use_device
    from pipeline.scene.exposure import ExposureGains

    train, views = inputs.drawing(job), inputs.trained_views(job)
    use_device(train.device)
    protocol = choose_protocol(views, job.section(Split), train)
    gaussians = inputs.trained_gaussians(job)
    evaluation = evaluate_views(
        gaussians,
        protocol,
        job.section(Evaluate),
        train,
        job.out / "renders",
        gains=ExposureGains.read_for(job.inputs["train"], [view.name for view in views]),
        appearance=read_appearance(job.inputs["train"], len(gaussians)),
        threads=job.threads,
    )
    if (known := job.key["published"]) is not None:
        published = against_published(known["scene"], known["deviations"], protocol, evaluation)
        described = evaluation.protocol.model_copy(update={"published": published})
        evaluation = evaluation.model_copy(update={"protocol": described})
        job.decide(published.text)
    job.add_messages([], evaluation.warnings)
    if (truth := job.inputs["inspect"] / "truth").is_dir():
        # The truth has the poses of photographs, not of the views of split ones.
        refined = train.refine_poses and all(view.source is None for view in views)
        if refined:
            model = inputs.trained_model(job, points=False)
        else:
            model = inputs.input_model(job, "poses", points=False)
        error = pose_error(model, read_model(truth, points=False))
        evaluation = evaluation.model_copy(update={"pose_error": error})
    evaluation.write(job.out)
    job.counters = EvaluateCounters.model_validate(evaluation, from_attributes=True)
    job.decide(
        f"PSNR {evaluation.psnr:.2f} dB, SSIM {evaluation.ssim:.4f}, FLIP {evaluation.flip:.4f}"
    )
    if not protocol.has_test_views:
        job.warn("there are no test views: quality was measured on training views")


def facts(plan: Plan) -> dict[str, Any]:
    from pipeline.metrics.lpips import weights_found
    from pipeline.plan.published import planned_deviations

    weights = weights_found(plan.config.evaluate.lpips_net)
    scene, published = plan.facts.published_scene, None
    if scene is not None:
        published = {"scene": scene, "deviations": planned_deviations(plan)}
    return {"lpips_weights": weights, "truth": plan.facts.truth_digest, "published": published}


SPEC = StageSpec(
    name="evaluate",
    work=work,
    decide=decide,
    counters=EvaluateCounters,
    inputs={**inputs.TRAINED, "inspect": ("inspect",)},
    options=("evaluate", "views", "split", *inputs.DRAWING_OPTIONS, *FIT_OPTIONS),
    packages=("torch", "numpy", "scipy", "opencv-contrib-python-headless"),
    facts=facts,
)
