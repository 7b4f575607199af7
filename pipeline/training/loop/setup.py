"""The views' pixels, cameras and depths during training, and the state before step 1."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
import torch

from pipeline.plan.training_memory import machine_mb, memory_mb
from pipeline.render import Backend, RasterCamera
from pipeline.render.views import near_plane, raster_camera
from pipeline.runtime.errors import UserError
from pipeline.runtime.memory import freed_memory
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.morton import in_morton_order
from pipeline.splats.skybox import SKYBOXES, Sky, of_fill
from pipeline.training.appearance.embedding import AppearanceEmbeddings
from pipeline.training.cameras.refinement import CameraRefinement
from pipeline.training.data.image_store import DiskStore, ImageStore, MemoryStore
from pipeline.training.data.inputs import Inputs
from pipeline.training.data.targets import Target, Targets
from pipeline.training.density import make_strategy
from pipeline.training.loop.state import TrainState
from pipeline.training.optimisers.adam import Adam, AdamOptions
from pipeline.training.run import TrainingRun
from pipeline.training.transients.search import MIN_VIEWS, Transients

Warn = Callable[[str], None]


@dataclass
class TrainingScene:
    """The scene during training; only the cache of cameras changes.

    Attributes:
        inputs: The inputs without views that their masks hide completely.
        targets: The pixels of ``inputs.views``.
        background: The background: black, white or random.
        near: The near plane, world units.
        sky: The skybox, None without one.
    """

    inputs: Inputs
    targets: Targets
    background: str
    near: float
    sky: Sky | None
    _cameras: dict[tuple[int, int], RasterCamera] = field(default_factory=dict)

    @property
    def views(self) -> Sequence[View]:
        return self.inputs.views

    def target(self, index: int, factor: int) -> Target:
        """The pixels of a view at 1 / ``factor`` of its size."""
        return self.targets.get(index, factor)

    def camera(self, index: int, factor: int) -> RasterCamera:
        """The given camera of a view at 1 / ``factor`` of its size."""
        if (index, factor) not in self._cameras:
            self._cameras[index, factor] = raster_camera(self.views[index], factor)
        return self._cameras[index, factor]


def load_scene(inputs: Inputs, run: TrainingRun, warn: Warn) -> TrainingScene:
    """Read the images of the views.

    Raises:
        UserError: An image cannot be read, or the masks hide all views.
    """
    targets = read_targets(inputs, run)
    near = near_plane(inputs.extent)
    inputs = _without_hidden_views(inputs, targets, warn)
    background, sky = run.options.background, None
    if background in SKYBOXES:
        background = "black"  # Behind the Gaussians of the skybox.
        sky = Sky(np.array([view.centre for view in inputs.views]))
    return TrainingScene(inputs, targets, background, near, sky)


def read_targets(inputs: Inputs, run: TrainingRun) -> Targets:
    """The pixels of the views, in memory if they fit beside the Gaussians, else in a file; always
    in a file for a scene in blocks, which are chosen to save memory."""
    store = choose_image_store(inputs, run)
    with freed_memory():
        return Targets(
            inputs.views,
            run.threads,
            store,
            inputs.open_layers(run.threads) if inputs.open_layers else None,
        )


def choose_image_store(inputs: Inputs, run: TrainingRun) -> ImageStore:
    """The storage for the pixels of the views; see ``read_targets``."""
    if run.is_part:
        return DiskStore()
    pixels = sum(view.width * view.height for view in inputs.views)
    limit = min(machine_mb(), run.memory_mb or math.inf)
    fits = memory_mb(pixels, run.options.density.max_gaussians) <= limit
    return MemoryStore() if fits else DiskStore()


def initial_state(
    scene: TrainingScene, run: TrainingRun, backend: Backend, warn: Warn
) -> TrainState:
    """The state before the first step of the run's part. In the middle of a schedule, the degree of
    spherical harmonics is that of the initial Gaussians."""
    inputs, options, start = scene.inputs, run.options, run.span.start
    rng = np.random.Generator(np.random.PCG64(run.seed))
    gaussians = inputs.initial if start else inputs.initial.with_sh_degree(0)
    # ``in_morton_order`` copies: the initial Gaussians stay as they are.
    gaussians = in_morton_order(_thinned(gaussians, options.density.max_gaussians, rng, warn))
    appearance = None
    if inputs.embeddings is not None:
        appearance = AppearanceEmbeddings(inputs.embeddings.copy())
        size = inputs.embeddings.shape[1]
        gaussians = replace(gaussians, appearance=torch.zeros(len(gaussians), size, 3))
    density = make_strategy(
        options, steps=run.steps, scale=inputs.size, extent=inputs.extent, sky=scene.sky
    )
    density.start(len(gaussians))
    cameras = CameraRefinement.of(scene.views, gaussians, inputs.extent, options)
    order = rng.permutation(len(scene.views))
    adam = Adam(gaussians, AdamOptions.of(options), backend)
    if scene.sky is not None:
        adam.freeze(torch.from_numpy(of_fill(gaussians.opacity_logits.numpy())))
    return TrainState(
        gaussians,
        adam,
        density,
        cameras,
        rng,
        order,
        appearance,
        transients=initial_transients(scene, run),
        clock=start,
    )


def initial_transients(scene: TrainingScene, run: TrainingRun) -> Transients | None:
    """The transients before the first search, or None if none are searched for."""
    few = len(scene.views) < MIN_VIEWS
    if run.options.transients == "none" or run.is_part or few or scene.targets.have_alpha:
        return None
    return Transients.of(scene.views, run.steps)


def _without_hidden_views(inputs: Inputs, targets: Targets, warn: Warn) -> Inputs:
    """Remove views without a usable pixel, also from ``targets``: their gradients are zero."""
    hidden = targets.hidden()
    if len(hidden) == len(inputs.views):
        raise UserError("the masks leave no pixel of any view to train on", fix="check masks/")
    if not hidden:
        return inputs
    names = ", ".join(inputs.views[index].name for index in islice(hidden, 5))
    warn(f"views that are completely masked are left out ({len(hidden)}): {names}")
    targets.drop(hidden)
    return inputs.without(hidden)


def _thinned(gaussians: Gaussians, limit: int, rng: np.random.Generator, warn: Warn) -> Gaussians:
    if len(gaussians) <= limit:
        return gaussians
    warn(
        f"{len(gaussians)} initial Gaussians are more than the budget: a random {limit} of them "
        "are used (train.density.max_gaussians)"
    )
    chosen = np.sort(rng.permutation(len(gaussians))[:limit])
    return gaussians.select(torch.from_numpy(chosen))
