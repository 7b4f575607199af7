"""Training of one block among its surroundings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pipeline.config.experiments import TrainExperiments
from pipeline.config.schema import Train
from pipeline.render import BACKGROUNDS, Color, RasterOptions, make_backend
from pipeline.render.views import near_plane
from pipeline.runtime.errors import UserError
from pipeline.scene.blocks import Partition
from pipeline.scene.exposure import ExposureGains
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View, reduced_size, resized
from pipeline.scene.visibility import seen_share
from pipeline.splats.gaussians import Gaussians
from pipeline.training.blocks.layers import BlockLayers
from pipeline.training.blocks.options import OVERVIEW_EVERY, OVERVIEW_FACTOR, block_options
from pipeline.training.data.inputs import Inputs
from pipeline.training.data.known_depths import KnownDepths
from pipeline.training.data.targets import usable_factor
from pipeline.training.loop.schedule import Part
from pipeline.training.scene import TrainedScene, run_training, scene_inputs


def train_block(
    views: list[View],
    manifest: Manifest,
    model: Reconstruction,
    scene: Gaussians,
    gains: ExposureGains,
    partition: Partition,
    number: int,
    config: Train,
    experiments: TrainExperiments,
    part: Part,
    *,
    seed: int,
    threads: int,
    memory_mb: int | None,
    checkpoint_dir: Path,
    logs: Path,
) -> TrainedScene:
    """Train block ``number`` on the training views that see it.

    Args:
        views: all views of the scene.
        scene: the Gaussians of the whole scene, from which the block starts and its surroundings
            are rendered.
        gains: of all views; empty if exposure is not modelled.
        part: of the schedule.

    Raises:
        UserError: no view sees the block, or see ``training.loop.train``.
    """
    block = partition.blocks[number - 1]
    if not block.views or not block.gaussians:
        raise UserError(f"no training view sees block {number}", fix="lower partition.blocks")
    share = block.pixels / max(1, sum(other.pixels for other in partition.blocks))
    whole = scene_inputs(views, manifest, model, scene, gains, config)
    background = config.background if config.background in BACKGROUNDS else "black"
    inputs = block_inputs(whole, partition, number, config, BACKGROUNDS[background])
    options, experiments = block_options(
        config,
        experiments,
        block,
        part,
        share=share,
        seen_share=inputs.seen_share,
        initial=len(inputs.initial),
    )
    return run_training(
        inputs,
        options,
        experiments,
        seed=seed,
        threads=threads,
        memory_mb=memory_mb,
        checkpoint_dir=checkpoint_dir,
        logs=logs,
        part=part,
    )


def block_inputs(
    scene: Inputs, partition: Partition, number: int, config: Train, background: Color
) -> Inputs:
    """The inputs of the training of block ``number``.

    Args:
        scene: the inputs of the whole scene; ``initial`` are the coarse Gaussians.
        background: behind the scene.
    """
    region, block = partition.region(number), partition.blocks[number - 1]
    windows = {view.name: view.window for view in block.views}
    shown = [index for index, view in enumerate(scene.views) if view.name in windows]
    views = [scene.views[index].cropped(*windows[scene.views[index].name]) for index in shown]
    overviews = range(0, len(scene.views), OVERVIEW_EVERY)
    kept = [*shown, *overviews]
    coarse = scene.initial
    own = torch.from_numpy(np.flatnonzero(region.contains(coarse.means.numpy())))
    options = RasterOptions(
        sh_degree=coarse.sh_degree,
        antialias=config.antialias,
        near=near_plane(scene.extent),
        threads=1,
    )
    initial = coarse.select(own)
    return Inputs(
        views=[*views, *(_overview(scene.views[index]) for index in overviews)],
        initial=initial,
        extent=scene.extent,
        scale=scene.scale,
        gains=None if scene.gains is None else scene.gains[kept],
        depths=scene.depths
        and [
            *(_cropped(scene.depths[i], windows[scene.views[i].name]) for i in shown),
            *(_scaled(scene.depths[i], scene.views[i]) for i in overviews),
        ],
        empty_depths=None if scene.empty_depths is None else scene.empty_depths[kept],
        seen_share=seen_share(initial.means.double().numpy(), views),
        layers=BlockLayers(coarse, region, background, options, make_backend()),
    )


def _overview(view: View) -> View:
    return resized(view, *reduced_size(view, usable_factor([view], OVERVIEW_FACTOR)))


def _scaled(known: KnownDepths, view: View) -> KnownDepths:
    """The known depths of the overview of a view."""
    small = _overview(view)
    xy = known.xy * (small.width / view.width, small.height / view.height)
    return KnownDepths(xy, known.z, known.weight)


def _cropped(known: KnownDepths, window: tuple[int, int, int, int]) -> KnownDepths:
    left, top, width, height = window
    xy = known.xy - (left, top)
    inside = ((xy >= 0) & (xy < (width, height))).all(1)
    return KnownDepths(xy[inside], known.z[inside], known.weight[inside])
