"""Descriptions of a partition and of the training of blocks."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.scene.blocks import Partition
from pipeline.training.blocks.counters import BlockCounters, PartitionCounters
from pipeline.training.loop.counters import ChangeCounters, TrainCounters
from pipeline.training.loop.curve import CurveRecord, TrainingCurve


def describe_partition(partition: Partition) -> tuple[PartitionCounters, list[str]]:
    """The counters of a partition, and a sentence for each block."""
    blocks = [
        BlockCounters(
            views=len(block.views),
            pixels=block.pixels,
            gaussians=block.gaussians,
            max_gaussians=block.max_gaussians,
            steps=block.steps,
        )
        for block in partition.blocks
    ]
    mean = sum(block.pixels for block in blocks) / len(blocks)
    largest = max(block.pixels for block in blocks) / mean if mean else 0.0
    sentences = [
        f"block {number}: {block.views} views, {block.pixels / 1e6:.1f} million pixels, "
        f"{block.gaussians} coarse and at most {block.max_gaussians} Gaussians, {block.steps} steps"
        for number, block in enumerate(blocks, 1)
    ]
    return PartitionCounters(blocks=blocks, largest_share=round(largest, 3)), sentences


def joined_counters(blocks: Sequence[TrainCounters], num_gaussians: int) -> TrainCounters:
    """The counters of a scene of which each block was trained: sums over the blocks."""
    names = [name for name in TrainCounters.model_fields if name not in ("changes", "depth_maps")]
    sums = {
        name: sum(getattr(block, name) for block in blocks)
        for name in names
        if all(isinstance(getattr(block, name), int) for block in blocks)
    }
    changes = {
        name: sum(getattr(block.changes, name) for block in blocks)
        for name in ChangeCounters.model_fields
    }
    others = {"num_gaussians": num_gaussians, "changes": changes, "device": blocks[0].device}
    return TrainCounters.model_validate(sums | others)


def joined_curve(curves: Sequence[TrainingCurve]) -> TrainingCurve:
    """The curve of a scene of which each block was trained: means over the blocks, and sums of
    steps and of Gaussians, with as many records as the shortest curve."""
    length = min(len(curve.root) for curve in curves)
    records = []
    for index in range(length):
        row = [curve.root[(index + 1) * len(curve.root) // length - 1] for curve in curves]
        records.append(
            CurveRecord(
                step=sum(record.step for record in row),
                loss=sum(record.loss for record in row) / len(row),
                psnr=sum(record.psnr for record in row) / len(row),
                num_gaussians=sum(record.num_gaussians for record in row),
            )
        )
    return TrainingCurve(tuple(records))


def joined_seconds(blocks: Sequence[Sequence[float]], length: int) -> list[float]:
    """Seconds at the records of ``joined_curve``, one block after the other."""
    return [
        sum(seconds[(index + 1) * len(seconds) // length - 1] for seconds in blocks)
        for index in range(length)
    ]
