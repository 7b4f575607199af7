"""A tiny scene of two clusters side by side, divided into two blocks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from pipeline.render import RasterOptions, make_backend
from pipeline.scene.blocks import Box, Partition
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians, concat
from pipeline.training.blocks.layers import BlockLayers
from pipeline.training.blocks.partition import PartitionOptions, make_partition
from tests.training.conftest import NUM_VIEWS, ball, camera_at

NEAR = 0.033
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class DividedScene:
    """``gaussians`` seen by ``views`` of 160 x 128 pixels; the blocks are cut across x."""

    gaussians: Gaussians
    views: list[View]
    partition: Partition


def moved(gaussians: Gaussians, x: float) -> Gaussians:
    return replace(gaussians, means=gaussians.means + torch.tensor([x, 0.0, 0.0]))


def divide(gaussians: Gaussians, views: list[View], blocks: int, threads: int = 1) -> Partition:
    raster = RasterOptions(near=NEAR, threads=threads)
    size = views[0].width * views[0].height
    options = PartitionOptions(blocks, np.eye(3), 1000, size, 40, 100, raster)
    return make_partition(gaussians, views, options, make_backend())


def layers_of(
    gaussians: Gaussians,
    partition: Partition,
    number: int,
    options: RasterOptions,
    corrects: Box | None = None,
) -> BlockLayers:
    box = corrects or partition.kept(number)
    return BlockLayers(gaussians, partition, number, box, WHITE, options, make_backend())


@pytest.fixture(scope="session")
def divided() -> DividedScene:
    gaussians = concat([moved(ball(60, 1), -1.4), moved(ball(60, 2), 1.4)])
    views = []
    for index in range(NUM_VIEWS):
        view = camera_at(index * 2 * np.pi / NUM_VIEWS)
        grown = {name: 4 * getattr(view, name) for name in ("fx", "fy", "cx", "cy")}
        views.append(replace(view, name=f"{index}", width=160, height=128, **grown))
    return DividedScene(gaussians, views, divide(gaussians, views, 2))
