"""Optimise the Gaussians, or unite those of the blocks that the scene was trained in. Outputs:
``gaussians.npz``, ``curve.json``, ``exposure.json``; ``sparse/0`` if poses or intrinsics were
refined; ``appearance.json`` and ``appearance.npz`` if colours differ between photographs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.plan.stage import StageSpec
from pipeline.plan.values import StagePlan
from pipeline.runtime.job import Job
from pipeline.training.loop.counters import TrainCounters
from stages.workflow import blocks, inputs

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    from pipeline.plan.budget import length_line, memory_line, resolution_line, small_views_line

    config, why = settled.config, settled.why
    settled_options = (
        "train.device",
        "train.density.max_gaussians",
        "train.background",
        "train.transients",
        "train.depth_loss_weight",
    )
    decisions = [
        resolution_line(scan, config),
        small_views_line(scan, config),
        *(why[name] for name in (*settled_options, "views.masks")),
        memory_line(scan, config),
    ]
    blocks = int(config.partition.blocks)
    reason = length_line(config)
    if blocks > 1:
        reason = f"{blocks} blocks of together about {reason}, united"
    return StagePlan(run=True, reason=reason, decisions=[text for text in decisions if text])


def work(job: Job) -> None:
    if "partition" in job.inputs:
        blocks.unite(job)
        return

    from pipeline.io.npz import read_npz
    from pipeline.training.scene import train_scene
    from stages.workflow.clear_places import with_clear_places
    from stages.workflow.training import scene_data, training_run

    trained = train_scene(
        scene_data(job),
        read_npz(job.inputs["init"] / "gaussians.npz"),
        training_run(job),
        dense=job.inputs.get("dense"),
    )
    inputs.write_trained(job, with_clear_places(job, trained))


SPEC = StageSpec(
    name="train",
    work=work,
    decide=decide,
    counters=TrainCounters,
    inputs={
        "views": inputs.VIEWS,
        "model": inputs.MODEL,
        "init": ("init",),
        "dense": ("dense",),
        "coarse": ("coarse",),
        "partition": ("partition",),
        "polish": ("polish",),
    },
    only_if={
        "dense": lambda config: config.init.method == "dense" and config.partition.blocks == 1
    },
    optional=("coarse", "partition", "polish"),
    options=("train", "views", "split", "experiments.train"),
    packages=("torch", "numpy", "scipy", "opencv-contrib-python-headless"),
    seeded=True,
)
