"""Held-out views against their photographs, poses against the truth where it is known, and what
the photographs did not see.

Outputs: ``evaluation.json`` with ``renders/``, ``coverage.json`` with ``coverage/``.
"""

import json
from dataclasses import asdict

from pipeline.config.schema import Evaluate, Split, Train, Views
from pipeline.coverage.measure import World, measure_coverage
from pipeline.metrics.evaluate import choose_protocol, evaluate_views
from pipeline.metrics.pose import pose_error
from pipeline.runtime.atomic import write_json
from pipeline.runtime.job import Job
from pipeline.scene.colmap import read_model
from pipeline.scene.manifest import Manifest
from pipeline.scene.model import View
from pipeline.scene.views import load_views, scene_up
from pipeline.splats.gaussians import Gaussians
from stages.command import main
from stages.models import trained_model


def run(job: Job) -> None:
    manifest = Manifest.read(job.inputs["views"] / "images.json")
    split = job.section(Split)
    model = trained_model(job)
    views = load_views(manifest, model, job.section(Views), split)
    train = job.section(Train)
    protocol = choose_protocol(views, split, train)
    gaussians = Gaussians.load(job.inputs["train"] / "gaussians.npz")
    evaluation = evaluate_views(
        gaussians,
        protocol,
        job.section(Evaluate),
        train,
        job.out / "renders",
        gains=json.loads((job.inputs["train"] / "exposure.json").read_text()),
        threads=job.threads,
    )
    for text in evaluation.pop("warnings"):
        job.warn(text)
    evaluation["pose_error"] = None
    truth = job.inputs["inspect"] / "truth"
    if truth.is_dir():
        poses = job.inputs["poses"] / "sparse" / "0"
        estimated = model if train.refine_poses else read_model(poses)
        evaluation["pose_error"] = asdict(pose_error(estimated, read_model(truth)))
    write_json(job.out / "evaluation.json", evaluation)
    world = world_of(job, manifest, views)
    measure_coverage(
        job.out, gaussians, views, protocol, train, evaluation, world, threads=job.threads
    )
    job.counters = {name: evaluation[name] for name in ("psnr", "ssim", "lpips")}
    job.decide(f"PSNR {evaluation['psnr']:.2f} dB, SSIM {evaluation['ssim']:.4f}")
    if not protocol.every:
        job.warn("no view was held out: quality was measured on training views")


def world_of(job: Job, manifest: Manifest, views: list[View]) -> World:
    up = scene_up(views, manifest)
    placed = job.inputs["poses"] / "georeference.json"
    unit = json.loads(placed.read_text()).get("unit", "") if placed.is_file() else ""
    return World(up, "m" if unit.startswith("metres") else None)


if __name__ == "__main__":
    main("evaluate", run, __doc__)
