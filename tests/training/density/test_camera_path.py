"""Gaussians that hide a view from between two cameras are removed; no others are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.render import RasterOptions
from pipeline.render.views import raster_camera
from pipeline.splats.gaussians import Gaussians, concat
from pipeline.training.data.inputs import Inputs
from pipeline.training.density.camera_path import (
    MAX_LENGTH,
    MIN_SIZE,
    NEIGHBOURS,
    REACH_SHARE,
    camera_path,
    distances_to_path,
    on_camera_path,
)
from pipeline.training.density.reduced_views import ReducedViews
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from tests.training.conftest import TinyScene, tiny_config

# Neighbouring cameras of the tiny scene are up to 3.3 apart.
EMPTY = 4.0


def between(scene: TinyScene, *, size: float = 0.02, aside: float = 0.04) -> Gaussians:
    """The scene, followed by a Gaussian beside the middle of the way between two cameras."""
    centres = np.stack([view.centre for view in scene.views])
    distance = np.linalg.norm(centres[:, None] - centres, axis=2) + 9 * np.eye(len(centres))
    first, second = np.unravel_index(distance.argmin(), distance.shape)
    added = scene.initial.select(torch.tensor([0]))
    up = np.array([0.0, 1.0, 0.0])
    added.means[:] = torch.from_numpy((centres[first] + centres[second]) / 2 + aside * up)
    added.log_scales.fill_(np.log(size))
    added.opacity_logits.fill_(2.0)
    return concat([scene.initial, added])


def found(scene: TinyScene, gaussians: Gaussians, depth: float = EMPTY) -> list[int]:
    cameras = [raster_camera(view) for view in scene.views]
    options = RasterOptions(sh_degree=0, threads=1)
    views = ReducedViews(cameras, options)
    flags = on_camera_path(gaussians, views, np.full(len(cameras), depth))
    return torch.nonzero(flags)[:, 0].tolist()


def test_a_gaussian_between_two_cameras_is_found(scene: TinyScene) -> None:
    assert found(scene, between(scene)) == [len(scene.initial)]


def test_small_and_transparent_gaussians_stay(scene: TinyScene) -> None:
    assert found(scene, between(scene, aside=0.04, size=0.9 * MIN_SIZE * 0.04)) == []
    faint = between(scene)
    faint.opacity_logits[-1] = -5.0
    assert found(scene, faint) == []


def test_a_gaussian_that_a_training_view_shows_stays(scene: TinyScene) -> None:
    gaussians = between(scene)
    view = scene.views[0]
    before_camera = view.centre + 0.3 * view.world_to_camera[2, :3]
    gaussians.means[-1] = torch.from_numpy(before_camera).float()
    gaussians.log_scales[-1] = np.log(0.3)
    assert found(scene, gaussians) == []


def test_no_path_leads_through_space_that_may_not_be_empty(scene: TinyScene) -> None:
    """Without points, or between cameras that are too far apart for their empty space."""
    assert found(scene, between(scene), 0.0) == []
    assert found(scene, between(scene), 0.5 / MAX_LENGTH) == []


def test_damaged_gaussians_stay(scene: TinyScene) -> None:
    damaged = between(scene)
    damaged.means[0] = float("nan")
    assert found(scene, damaged) == [len(scene.initial)]


def point_to_segment(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """By sampling, in error by no more than the length over 4000."""
    along = np.linspace(0, 1, 2001)[:, None]
    return float(np.linalg.norm(start + along * (end - start) - point, axis=1).min())


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 9), together=st.booleans())
def test_distances_are_those_to_the_nearest_segment_in_reach(
    seed: int, count: int, together: bool
) -> None:
    rng = np.random.default_rng(seed)
    centres = rng.normal(size=(count + 1, 3)) * (0 if together else 1)
    depths = rng.uniform(0, 3, count + 1)
    segments = camera_path(centres, depths)
    assert len(segments) <= NEIGHBOURS * len(centres)
    points = rng.normal(size=(20, 3))
    distances = distances_to_path(points, segments)
    for point, distance in zip(points, distances, strict=True):
        sampled = [(point_to_segment(point, s.start, s.end), s.reach) for s in segments]
        bounds = [
            min((d for d, reach in sampled if d < reach + tolerance), default=np.inf)
            for tolerance in (0.01, -0.01)
        ]
        assert bounds[0] - 0.01 < distance <= bounds[1] + 0.01 or bounds[0] == distance == np.inf
    for segment in segments:
        length = np.linalg.norm(segment.end - segment.start)
        assert length <= MAX_LENGTH * segment.reach / REACH_SHARE


def test_training_removes_them_at_its_end(scene: TinyScene, tmp_path: Path) -> None:
    still = {"learning_rate_factor": 1e-9}
    depths = np.full(len(scene.views), EMPTY)
    inputs = Inputs(scene.views, between(scene), scene.extent, empty_depths=depths)
    for remove in (True, False):
        config = tiny_config(4, **still, density={"grad_threshold": 1e6, "remove_floaters": remove})
        folder = tmp_path / str(remove)
        result = train(inputs, TrainingRun(config, folder, seed=3, threads=1))
        assert result.counters["floaters"] == remove
        assert len(result.gaussians) == len(inputs.initial) - remove
