"""Training on photographs in two lights: embeddings explain them; resumed runs equal others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.config.settled import TrainOptions
from pipeline.render import RasterOptions, make_backend
from pipeline.render.views import render_view
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View
from pipeline.training.appearance.fit import in_photograph
from pipeline.training.appearance.start import initial_embeddings
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop import session
from pipeline.training.loop.result import TrainResult
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from tests.tools import need_gpu
from tests.training.conftest import WIDTH, TinyScene, killed_in_step, tiny_config


@pytest.fixture(scope="module")
def views(scene: TinyScene, tmp_path_factory: pytest.TempPathFactory) -> list[View]:
    """Each view twice: by day, and with the colours of the Gaussians in another light, which is no
    function of their colours by day."""
    folder = tmp_path_factory.mktemp("lights")
    other = replace(scene.truth, sh=scene.truth.sh.clone())
    other.sh[:, 0] = torch.randn(len(other), 3, generator=torch.manual_seed(7))
    found = list(scene.views)
    for index, view in enumerate(scene.views):
        file = folder / f"night{index}.png"
        rgb = np.rint(render_view(other, view).rgb * 255).astype(np.uint8)
        Image.fromarray(rgb).save(file)
        found.append(replace(view, name=file.name, image=str(file)))
    return found


def start_of(scene: TinyScene, views: list[View], size: int) -> np.ndarray:
    points = scene.truth.means.double().numpy()
    return initial_embeddings(views, Reconstruction({}, {}), points, None, size)


def run(
    scene: TinyScene,
    views: list[View],
    folder: Path,
    config: TrainOptions,
    *,
    embeddings: bool = True,
    threads: int = 1,
) -> TrainResult:
    inputs = Inputs(views, scene.initial, scene.extent)
    if embeddings:
        inputs = replace(inputs, embeddings=start_of(scene, views, 2))
    return train(inputs, TrainingRun(config, folder, seed=3, threads=threads))


def assert_same(a: TrainResult, b: TrainResult) -> None:
    for name, tensor in a.gaussians.tensors().items():
        assert torch.equal(tensor, b.gaussians.tensors()[name]), name
    assert a.appearance is not None and b.appearance is not None
    assert np.array_equal(a.appearance.colors, b.appearance.colors)
    for name, values in a.appearance.embeddings.items():
        assert np.array_equal(values, b.appearance.embeddings[name]), name
    assert a.curve == b.curve


def test_embeddings_explain_two_lights(scene: TinyScene, views: list[View], tmp_path: Path) -> None:
    config = tiny_config(240)
    without = run(scene, views, tmp_path / "a", config, embeddings=False)
    found = run(scene, views, tmp_path / "b", config)
    assert without.appearance is None
    assert found.curve.root[-1].psnr > without.curve.root[-1].psnr + 4
    assert found.gaussians.appearance is None
    assert found.appearance is not None
    assert found.appearance.colors.shape == (len(found.gaussians), 2, 3)
    assert found.appearance.embeddings.keys() == {view.name for view in views}
    # A photograph that was not trained on: its light is found on the left half.
    day, night = views[0], views[len(scene.views)]
    errors = []
    for view in (day, night):
        unknown, photo = replace(view, name="unknown"), np.array(Image.open(view.image))
        shown = in_photograph(
            found.gaussians, found.appearance, unknown, photo, None, RasterOptions(sh_degree=1)
        )
        right = slice(WIDTH // 2, None)
        for gaussians in (shown, found.gaussians):
            image = render_view(gaussians, view).rgb[:, right]
            errors.append(float(np.square(image - photo[:, right] / 255).mean()))
    day_fit, day_own, night_fit, night_own = errors
    assert day_fit < 0.6 * day_own
    assert night_fit < 0.6 * night_own


@pytest.mark.parametrize("strategy", ["gradient", "mcmc"])
def test_a_killed_run_resumes_to_the_same_bits(
    scene: TinyScene,
    views: list[View],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    strategy: str,
) -> None:
    config = tiny_config(40, density={"strategy": strategy})
    whole = run(scene, views, tmp_path / "whole", config)
    with killed_in_step(monkeypatch, 23):
        run(scene, views, tmp_path / "cut", config)
    assert_same(whole, run(scene, views, tmp_path / "cut", config, threads=2))


def test_a_checkpoint_of_other_embeddings_is_not_used(
    scene: TinyScene, views: list[View], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
    config = tiny_config(10)
    run(scene, views, tmp_path, config, embeddings=False)
    said: list[str] = []
    inputs = Inputs(views, scene.initial, scene.extent, embeddings=start_of(scene, views, 2))
    train(inputs, TrainingRun(config, tmp_path, seed=3, threads=1), log=said.append)
    assert any("other inputs" in line for line in said)


def test_training_without_embeddings_renders_as_before(
    scene: TinyScene, views: list[View], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No gradients of colours are computed."""
    asked = []
    update = make_backend().update

    def watched(*args: object, **options: object) -> object:
        asked.append(options["colors"])
        return update(*args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(make_backend(), "update", watched)
    run(scene, views, tmp_path, tiny_config(3), embeddings=False)
    assert asked == [False] * 3


def test_a_gpu_finds_the_same_lights(scene: TinyScene, views: list[View], tmp_path: Path) -> None:
    need_gpu()
    cpu, gpu, again = (
        run(scene, views, tmp_path / name, tiny_config(60, device=device))
        for name, device in (("a", "cpu"), ("b", "gpu"), ("c", "gpu"))
    )
    assert_same(gpu, again)
    assert gpu.curve.root[-1].psnr == pytest.approx(cpu.curve.root[-1].psnr, abs=0.5)
    assert cpu.appearance is not None and gpu.appearance is not None
    for name, values in cpu.appearance.embeddings.items():
        np.testing.assert_allclose(gpu.appearance.embeddings[name], values, atol=0.1)
