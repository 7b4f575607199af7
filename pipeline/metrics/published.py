"""Comparison of how a scene was measured with the published protocol of its benchmark."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.metrics.evaluation import Evaluation, PublishedProtocol
from pipeline.metrics.image import SSIM_VARIANT
from pipeline.metrics.lpips import LPIPS_VARIANTS
from pipeline.metrics.protocol import Protocol
from pipeline.plan.protocols import PUBLISHED_SCENES, PublishedScene
from pipeline.render import BACKGROUNDS


def against_published(
    name: str, deviations: Sequence[str], protocol: Protocol, evaluation: Evaluation
) -> PublishedProtocol:
    """The published benchmark of a scene, with all that was done otherwise.

    Args:
        name: The title of a scene of ``PUBLISHED_SCENES``.
        deviations: The deviations that are known from the plan.
        protocol, evaluation: The protocol of the measurement and its result.
    """
    scene, described = PUBLISHED_SCENES[name], evaluation.protocol
    found = list(deviations)
    width, height = scene.size
    if described.resolution != (f"{width}x{height}",):
        sizes = ", ".join(described.resolution)
        found.append(f"views of {sizes} pixels, not {width}x{height}")
    found += _test_views(scene, protocol)
    if described.num_views != len(protocol.views):
        found.append(f"only {described.num_views} of {len(protocol.views)} views are measured")
    if scene.background is not None and protocol.background != BACKGROUNDS[scene.background]:
        found.append(f"the background is not {scene.background}")
    found += [
        text
        for text in (described.masks, described.exposure, described.appearance, described.poses)
        if text
    ]
    if described.ssim != SSIM_VARIANT:
        found.append(f"SSIM: {described.ssim}")
    if evaluation.lpips is not None and described.lpips != LPIPS_VARIANTS["vgg"]:
        found.append(f"LPIPS: {described.lpips}, not {LPIPS_VARIANTS['vgg']}")
    return PublishedProtocol(
        benchmark=scene.benchmark,
        scene=scene.scene,
        train_views=scene.train_views,
        deviations=tuple(found),
    )


def _test_views(scene: PublishedScene, protocol: Protocol) -> list[str]:
    """How training and test views differ from the published ones."""
    views, training = len(protocol.views), protocol.num_training
    if protocol.train_views != scene.train_views:
        return [f"only {training} training views"]
    if scene.train_views is not None:
        found = [] if views == scene.num_test else [f"{views} test views, not {scene.num_test}"]
        if training != scene.train_views:
            found.append(f"{training} training views, not {scene.train_views}")
        return found
    if scene.every is None:
        if not protocol.listed:
            return ["test views are not those that the data set lists"]
        return [f"{views} test views, not {scene.num_test}"] if views != scene.num_test else []
    if protocol.listed or protocol.every != scene.every:
        return [
            f"test views are not every {scene.every}th view"
            if scene.every
            else "there are test views; papers train and measure on all views"
        ]
    return []
