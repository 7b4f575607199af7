"""Which views of a scene are measured, and how they are rendered. Importing this module does not
import torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.config.schema import Split, Train
from pipeline.render import BACKGROUNDS, Color, RasterOptions
from pipeline.render.views import near_plane
from pipeline.scene.views import View, evenly_spaced, scene_extent

#: Number of training views that are rendered for ``train_psnr``.
NUM_TRAINING_VIEWS = 8


@dataclass(frozen=True)
class Protocol:
    """How the quality of a scene is measured.

    Attributes:
        views: The evaluated views: the test views, or all views if there are none.
        training_views: An even sample of the training views; empty without test views.
        every: Every n-th view, sorted by name, is a test view; 0: there are none, or ``listed``.
        num_training: The number of training views.
        listed: Whether the views are test views of the scene's own split, or of the choice of
            ``split.train_views``.
        train_views: The value of ``split.train_views``.
        background: RGB in [0, 1] behind renders and transparent photographs.
        near: The near plane of the renders, as in training; world units.
        extent: The radius of the scene, world units (``scene_extent``).
    """

    views: list[View]
    training_views: list[View]
    every: int
    background: Color
    near: float
    extent: float
    num_training: int
    listed: bool
    train_views: int | None = None

    @property
    def has_test_views(self) -> bool:
        return self.every > 0 or self.listed

    def options(self, train: Train, threads: int) -> RasterOptions:
        """Options of the rasterizer: as in training, over ``background``."""
        return RasterOptions(
            sh_degree=train.sh_degree,
            background=self.background,
            antialias=train.antialias,
            near=self.near,
            threads=threads,
        )


def choose_protocol(views: Sequence[View], split: Split, train: Train) -> Protocol:
    """The views to evaluate on (the test views; without any, all) and the background.

    The background is that of training. If that is random (images with alpha), it is white, as is
    usual for NeRF-synthetic scenes.
    """
    test = [view for view in views if view.is_test]
    training = [view for view in views if not view.is_test]
    extent = scene_extent(list(views))
    listed = any(view.has_listed_split for view in test)
    return Protocol(
        test or list(views),
        evenly_spaced(training, NUM_TRAINING_VIEWS) if test else [],
        split.test_every if test and not listed else 0,
        BACKGROUNDS["white" if train.background in ("white", "random") else "black"],
        near_plane(extent),
        extent,
        len(training),
        listed,
        split.train_views,
    )
