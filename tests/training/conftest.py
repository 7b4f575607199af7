"""A tiny scene: renders of known Gaussians as photographs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.config.experiments import TrainExperiments
from pipeline.config.options import option_paths
from pipeline.config.settled import Train, TrainOptions
from pipeline.render import make_backend
from pipeline.render.views import render_view
from pipeline.scene.views import View, resized
from pipeline.splats.gaussians import Gaussians
from pipeline.training.loop import session
from pipeline.training.loop.result import TrainResult

WIDTH, HEIGHT, FOCAL = 40, 32, 40.0
NUM_VIEWS = 6
# The scene with someone who passes by: its views, and the pixels of the fourth that show them.
CROWDED_VIEWS, PERSON = 10, (slice(20, 44), slice(30, 46))


@dataclass
class TinyScene:
    """``views`` have images without alpha, ``alpha_views`` the same with alpha."""

    truth: Gaussians
    initial: Gaussians
    views: list[View]
    alpha_views: list[View]
    extent: float


def tiny_config(
    steps: int = 40, density: dict[str, object] | None = None, **changes: object
) -> TrainOptions:
    """TrainOptions of a training short enough for a test, with every phase in it.

    Args:
        density: options of density control and of experiments with it, for each strategy.
        changes: other options of ``Train`` and ``TrainExperiments``.
    """
    values: dict[str, object] = {"steps": steps, "sh_degree": 1}
    # The scene's six views would be few.
    values |= {"dropout": 0.0, "views_per_sh_coefficient": 0.0}
    values |= {"sh_degree_interval": 2000, "coarse_share": 0.0} | changes
    control = {"start_step": 700, "interval": 1750, "stop_share": 0.7, "max_gaussians": 130}
    control |= density or {}  # type: ignore[arg-type]
    product = {path.removeprefix("train.density.") for path in option_paths()}
    kept = {name: control.pop(name) for name in list(control) if name in product}
    strategies = {
        name: {k: v for k, v in control.items() if k in field.annotation.model_fields}  # type: ignore[union-attr]
        for name, field in TrainExperiments.model_fields.items()
        if name in ("gradient", "mcmc")
    }
    train = {name: values.pop(name) for name in list(values) if name in Train.model_fields}
    return TrainOptions.model_validate(
        train | {"density": kept, "experiments": values | strategies}
    )


def ball(count: int, seed: int) -> Gaussians:
    rng = np.random.default_rng(seed)
    sh = np.zeros((count, 4, 3), np.float32)
    sh[:, 0] = rng.uniform(-1.5, 1.5, (count, 3))
    return Gaussians.from_arrays(
        {
            "means": rng.normal(size=(count, 3)) * 0.5,
            "log_scales": rng.uniform(-2.5, -1.7, (count, 3)),
            "quats": rng.normal(size=(count, 4)),
            "opacity_logits": rng.uniform(0.5, 3.0, count),
            "sh": sh,
        }
    )


def camera_at(angle: float) -> View:
    centre = 3.0 * np.array([np.sin(angle), 0.2, -np.cos(angle)])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    half = WIDTH / 2, HEIGHT / 2
    return View("", "", None, WIDTH, HEIGHT, FOCAL, FOCAL, *half, pose, False)


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> TinyScene:
    folder: Path = tmp_path_factory.mktemp("tiny")
    truth = ball(60, 1)
    views, alpha_views = [], []
    for index in range(NUM_VIEWS):
        view = camera_at(index * 2 * np.pi / NUM_VIEWS)
        render = render_view(truth, view)
        rgb = np.rint(render.rgb * 255).astype(np.uint8)
        Image.fromarray(rgb).save(folder / f"{index}.png")
        alpha = np.rint(render.alpha * 255).astype(np.uint8)
        straight = np.where(alpha[..., None] > 0, render.rgb / (alpha[..., None] / 255 + 1e-9), 0)
        rgba = np.dstack([np.rint(np.clip(straight, 0, 1) * 255).astype(np.uint8), alpha])
        Image.fromarray(rgba).save(folder / f"{index}a.png")
        views.append(replace(view, name=f"{index}.png", image=str(folder / f"{index}.png")))
        alpha_views.append(replace(view, name=f"{index}a.png", image=str(folder / f"{index}a.png")))
    initial = ball(60, 1)
    rng = np.random.default_rng(5)
    initial.means += initial.means.new_tensor(rng.normal(size=(60, 3)) * 0.05)
    initial.sh.zero_()
    initial.opacity_logits.fill_(-1.0)
    return TinyScene(truth, initial, views, alpha_views, extent=3.3)


@pytest.fixture(scope="session")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> tuple[TinyScene, list[View]]:
    """A scene of an opaque ball, and its views with a bright square in the fourth one."""
    folder = tmp_path_factory.mktemp("crowd")
    truth = ball(150, 1)
    truth.opacity_logits.fill_(4.0)
    plain, crowded = [], []
    for index in range(CROWDED_VIEWS):
        view = resized(camera_at(index * 2 * np.pi / CROWDED_VIEWS), 2 * WIDTH, 2 * HEIGHT)
        rgb = np.rint(render_view(truth, view).rgb * 255).astype(np.uint8)
        for views, name in ((plain, f"{index}.png"), (crowded, f"{index}c.png")):
            if views is crowded and index == 3:
                rgb = rgb.copy()
                rgb[PERSON] = (250, 20, 240)
            Image.fromarray(rgb).save(folder / name)
            views.append(replace(view, name=f"{index}.png", image=str(folder / name)))
    initial = truth.clone()
    initial.sh.mul_(0.8)
    return TinyScene(truth, initial, plain, [], extent=3.3), crowded


def person_error(result: TrainResult, scene: TinyScene) -> float:
    """The mean absolute error of the fourth view's square against the scene without it."""
    view = scene.views[3]
    photo = np.asarray(Image.open(view.image))[PERSON] / 255.0
    return float(np.abs(render_view(result.gaussians, view).rgb[PERSON] - photo).mean())


@contextmanager
def killed_in_step(patch: pytest.MonkeyPatch, step: int) -> Iterator[None]:
    """Training inside writes a checkpoint after every step and is interrupted in this step."""
    original, calls = make_backend().l1_ssim, 0

    def dying(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == step:
            raise KeyboardInterrupt
        return original(*args, **kwargs)

    with patch.context() as inside, pytest.raises(KeyboardInterrupt):
        inside.setattr(session, "CHECKPOINT_SECONDS", 0.0)
        inside.setattr(make_backend(), "l1_ssim", dying)
        yield
