"""Keeps places beside the cameras free in a trained scene. It is separate from ``training``, which
the jobs of blocks import as well, so that their keys do not change with coverage."""

from __future__ import annotations

from dataclasses import replace

import torch

from pipeline.coverage.clearing import hides_free_places
from pipeline.render import RasterOptions
from pipeline.runtime.job import Job
from pipeline.scene.views import scene_up
from pipeline.training.scene import TrainedScene
from stages.workflow import inputs


def with_clear_places(job: Job, trained: TrainedScene) -> TrainedScene:
    """The trained scene without the Gaussians that hide it from places beside the cameras
    (``coverage.clearing``), if the density strategy removes floaters."""
    train, result = inputs.drawing(job), trained.result
    if not getattr(train.density, "remove_floaters", False):
        return trained
    views = inputs.posed_views(job, trained.model)
    up = scene_up(views, inputs.read_manifest(job, "views"))
    options = RasterOptions(antialias=train.antialias, near=result.near, threads=job.threads)
    hiding = hides_free_places(result.gaussians, views, up, options)
    count, kept = int(hiding.sum()), torch.nonzero(~hiding)[:, 0]
    if not count or not len(kept):
        return trained
    appearance = result.appearance
    if appearance is not None:
        appearance = replace(appearance, colors=appearance.colors[kept.numpy()])
    result = replace(result, gaussians=result.gaussians.select(kept), appearance=appearance)
    what = f"{count} Gaussians that hid the scene from places beside the cameras were removed"
    counters = trained.counters.model_copy(
        update={"num_gaussians": len(kept), "floaters": trained.counters.floaters + count}
    )
    return replace(trained, result=result, counters=counters, decisions=[*trained.decisions, what])
