"""The inputs of the training of one block."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from pipeline.render import BACKGROUNDS, RasterOptions, make_backend
from pipeline.render.views import near_plane
from pipeline.runtime.errors import UserError
from pipeline.scene.blocks import Partition
from pipeline.scene.exposure import ExposureGains
from pipeline.scene.views import View, reduced_size, resized
from pipeline.scene.visibility import seen_share
from pipeline.splats.arrays import NAMES, GaussianArrays, GaussianSource
from pipeline.splats.gaussians import Gaussians, concat
from pipeline.training.blocks.layers import BlockLayers
from pipeline.training.blocks.options import OVERVIEW_FACTOR, block_run, corrected_box
from pipeline.training.data.inputs import Inputs
from pipeline.training.data.known_depths import KnownDepths
from pipeline.training.data.targets import usable_factor
from pipeline.training.run import TrainingRun
from pipeline.training.scene import SceneData, scene_inputs


@dataclass(frozen=True)
class SceneInBlocks:
    """A scene of which blocks are trained.

    Attributes:
        data: The scene.
        gains: The gains of all views; empty if exposure is not modelled.
        read_gaussians: Reads the Gaussians of the whole scene, from which each block starts and its
            surroundings are rendered. They are not held while a block is trained.
    """

    data: SceneData
    gains: ExposureGains
    partition: Partition
    read_gaussians: Callable[[], Gaussians]


def block_training(
    scene: SceneInBlocks, number: int, run: TrainingRun
) -> tuple[Inputs, TrainingRun]:
    """The inputs and the run of a part of the training of block ``number``: the training views that
    see it, or as many of them as the part has steps.

    Args:
        run: The part of the training of the whole scene.

    Raises:
        UserError: No view sees the block.
    """
    partition = scene.partition
    block = partition.blocks[number - 1]
    if not block.views or not block.gaussians:
        raise UserError(f"no training view sees block {number}", fix="lower partition.blocks")
    share = block.pixels / max(1, sum(other.pixels for other in partition.blocks))
    inputs = block_inputs(scene, number, run)
    run = block_run(run, block, share=share, inputs=inputs)
    if run.options.budget_minutes is None:
        # No other views are read, and no layers are rendered in them.
        rng = np.random.Generator(np.random.PCG64([run.seed, number]))
        inputs = inputs.sampled(len(run.span), rng)
    return inputs, run


def block_inputs(scene: SceneInBlocks, number: int, run: TrainingRun) -> Inputs:
    """The inputs of a part of the training of block ``number``: its windows in the views that see
    it, and overviews."""
    settings = run.options
    partition, gains, read_gaussians = scene.partition, scene.gains, scene.read_gaussians
    gaussians = read_gaussians()
    whole = scene_inputs(scene.data, gaussians, run, gains)
    block = partition.blocks[number - 1]
    windows, through = {view.name: view for view in block.views}, set(block.overviews)
    shown = [index for index, view in enumerate(whole.views) if view.name in windows]
    views = [
        whole.views[index].cropped(*windows[whole.views[index].name].window) for index in shown
    ]
    overviews = [index for index, view in enumerate(whole.views) if view.name in through]
    kept = [*shown, *overviews]
    region = partition.region(number)
    own = torch.from_numpy(np.flatnonzero(region.contains(gaussians.means.numpy())))
    initial = gaussians.select(own)
    options = RasterOptions(
        sh_degree=gaussians.sh_degree,
        antialias=settings.antialias,
        near=near_plane(whole.extent),
    )
    background = settings.background if settings.background in BACKGROUNDS else "black"

    def open_layers(threads: int) -> BlockLayers:
        return BlockLayers(
            read_gaussians(),
            partition,
            number,
            corrected_box(partition, number, run.part),
            BACKGROUNDS[background],
            replace(options, threads=threads),
            make_backend(),
            gains,
        )

    return Inputs(
        views=[*views, *(_overview(whole.views[index]) for index in overviews)],
        initial=initial,
        extent=whole.extent,
        scale=whole.scale,
        light=None if whole.light is None else [whole.light[index] for index in kept],
        depths=whole.depths
        and [
            *(_cropped(whole.depths[i], windows[whole.views[i].name].window) for i in shown),
            *(_scaled(whole.depths[i], whole.views[i]) for i in overviews),
        ],
        empty_depths=None if whole.empty_depths is None else whole.empty_depths[kept],
        seen_share=seen_share(initial.means.double().numpy(), views),
        open_layers=open_layers,
    )


def with_far_field(
    trained: Gaussians, scene: GaussianSource, partition: Partition, number: int
) -> Gaussians:
    """The trained Gaussians of block ``number``, and those of the scene beyond its bounds that are
    in the block's box, unchanged. All blocks see the far field behind their own Gaussians: none may
    change it while others are trained."""
    box, bounds = partition.box(number), partition.bounds
    degree = max(trained.sh_degree, scene.sh_degree)
    parts = [trained.with_sh_degree(degree)]
    for arrays in scene.chunks(*NAMES):
        far = box.contains(arrays[0]) & ~bounds.contains(arrays[0])
        found = Gaussians.sharing(GaussianArrays(*(values[far] for values in arrays)))
        parts.append(found.with_sh_degree(degree))
    return concat(parts)


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
