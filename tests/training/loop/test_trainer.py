"""Training a tiny scene: it converges, resumes to the same bits, and stops with clear errors."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from pipeline.config.settled import TrainOptions
from pipeline.io.npz import write_npz
from pipeline.render import RasterOptions, make_backend
from pipeline.render.views import render_view
from pipeline.runtime.errors import UserError
from pipeline.scene.exposure import ViewLight
from pipeline.scene.views import View, resized
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import InitGaussians
from pipeline.splats.skybox import NUM_GAUSSIANS, with_skybox
from pipeline.training.checkpoints.checkpoint import PATTERN
from pipeline.training.data import targets
from pipeline.training.data.image_store import DiskStore, MemoryStore
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop import metrics_log, session, setup
from pipeline.training.loop.result import TrainResult
from pipeline.training.loop.train import train
from pipeline.training.run import Part, TrainingRun
from tests.training.conftest import HEIGHT, WIDTH, TinyScene, ball, tiny_config


def run(
    scene: TinyScene,
    folder: Path,
    config: TrainOptions | None = None,
    views: list[View] | None = None,
    threads: int = 1,
    seed: int = 3,
    said: list[str] | None = None,
    logs: Path | None = None,
    memory_mb: int | None = None,
) -> TrainResult:
    return train(
        Inputs(scene.views if views is None else views, scene.initial, scene.extent),
        TrainingRun(
            config or tiny_config(),
            folder,
            logs=logs,
            seed=seed,
            threads=threads,
            memory_mb=memory_mb,
        ),
        log=[].append if said is None else said.append,
    )


def assert_same(a: TrainResult, b: TrainResult) -> None:
    for name, tensor in a.gaussians.tensors().items():
        assert torch.equal(tensor, b.gaussians.tensors()[name]), name
    assert a.curve == b.curve
    assert a.counters == b.counters


def interrupt_at(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """Kill the run in the middle of its ``call``-th step."""
    calls = 0
    original = make_backend().l1_ssim

    def dying(*args: object, **kwargs: object) -> object:
        nonlocal calls
        calls += 1
        if calls == call:
            raise KeyboardInterrupt
        return original(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(make_backend(), "l1_ssim", dying)


def test_gaussians_that_no_view_sees_are_removed(scene: TinyScene, tmp_path: Path) -> None:
    """One Gaussian is above all cameras, another inside an opaque ball of others. A run too short
    for each photograph to have been looked at knows nothing."""
    initial = scene.initial.select(torch.arange(len(scene.initial)))
    initial.means[0] = torch.tensor([0.0, -50.0, 0.0])
    initial.means[1] = 0.0
    initial.log_scales[1] = -6.0
    around = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.manual_seed(0)))
    initial.means[2:42] = 0.3 * around
    initial.log_scales[2:42] = -1.0
    initial.opacity_logits[2:42] = 12.0
    fixed = tiny_config(
        40, density={"stop_share": 0.0}, means_learning_rate=0.0, opacities_learning_rate=0.0
    )
    planted = replace(scene, initial=initial)
    result = run(planted, tmp_path / "a", fixed)
    assert result.counters["unseen"] == len(initial) - len(result.gaussians) >= 2
    places = result.gaussians.means
    assert not (places == initial.means[0]).all(1).any()
    assert not (places == initial.means[1]).all(1).any()
    assert (places == initial.means[2]).all(1).any()
    # With a skybox, the far one is part of it.
    initial.means[0] = torch.tensor([0.0, -500.0, 0.0])
    sky = fixed.model_copy(update={"background": "skybox"})
    kept = run(planted, tmp_path / "c", sky).gaussians.means
    assert (kept == initial.means[0]).all(1).any() and not (kept == initial.means[1]).all(1).any()
    steps = 2 * len(scene.views) - 1
    short = run(planted, tmp_path / "b", fixed.model_copy(update={"steps": steps}))
    assert short.counters["unseen"] == 0 and len(short.gaussians) == len(initial)


@pytest.mark.parametrize("strategy", ["gradient", "mcmc"])
def test_training_changes_a_skybox_but_not_the_fill_behind_it(
    scene: TinyScene, tmp_path: Path, strategy: str
) -> None:
    """All photographs see it between the other Gaussians, through opacity resets, density control
    and a rise of the SH degree."""
    centres = np.array([view.centre for view in scene.views])
    points = scene.initial.with_sh_degree(0).tensors().items()
    arrays = InitGaussians(**{name: tensor.numpy() for name, tensor in points})
    shells = with_skybox(arrays, centres).arrays().items()
    initial = Gaussians(**{name: torch.from_numpy(array) for name, array in shells})
    options = tiny_config(
        60,
        density={"strategy": strategy, "max_gaussians": 1500, "opacity_reset_interval": 3000},
        sh_degree_interval=1000,
        background="skybox",
    )
    trained = run(replace(scene, initial=initial), tmp_path, options)
    assert trained.counters["changes"]["split"] + trained.counters["changes"]["cloned"] > 0
    found = {tuple(mean): row for row, mean in enumerate(trained.gaussians.means.tolist())}
    sky, fill = initial.means[-2 * NUM_GAUSSIANS :].split(NUM_GAUSSIANS)
    assert not all(tuple(mean) in found for mean in sky.tolist())
    rows = torch.tensor([found[tuple(mean)] for mean in fill.tolist()])
    expected = initial.select(torch.arange(len(initial) - NUM_GAUSSIANS, len(initial)))
    kept = trained.gaussians.select(rows).tensors()
    for name, tensor in expected.with_sh_degree(options.sh_degree).tensors().items():
        assert torch.allclose(tensor, kept[name], rtol=0.0, atol=1e-9), name


def test_images_read_from_disk_give_the_same_bits(scene: TinyScene, tmp_path: Path) -> None:
    config = tiny_config(coarse_share=0.3)
    inputs = Inputs(scene.views, scene.initial, scene.extent)
    for changes, kind in (
        ({}, MemoryStore),
        ({"memory_mb": 1}, DiskStore),
        ({"part": Part(0.0, 0.5)}, DiskStore),
    ):
        store = setup.choose_image_store(inputs, TrainingRun(config, tmp_path, **changes))
        assert isinstance(store, kind), changes
    little = run(scene, tmp_path / "b", config, memory_mb=1)
    assert_same(run(scene, tmp_path / "a", config), little)


def test_training_recovers_the_scene(scene: TinyScene, tmp_path: Path) -> None:
    result = run(scene, tmp_path, tiny_config(500))
    assert result.steps == 500
    assert result.counters["changes"]["cloned"] + result.counters["changes"]["split"] > 0
    assert result.curve.root[-1].loss < 0.4 * result.curve.root[0].loss
    assert result.curve.root[-1].psnr > result.curve.root[0].psnr + 8
    assert result.gaussians.sh_degree == 1
    assert len(result.curve.root) == len(result.curve_seconds)
    view = scene.views[0]
    rendered = render_view(result.gaussians, view, RasterOptions(near=result.near)).rgb
    error = np.mean((rendered - np.asarray(Image.open(view.image)) / 255.0) ** 2)
    assert -10 * np.log10(error) > 25


@pytest.mark.parametrize("call", [1, 2, 10, 11, 13, 23, 40])
def test_killed_and_resumed_gives_the_same_bits(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: int
) -> None:
    # Resolution rises after steps 12 and 24, opacity is reset after step 10.
    monkeypatch.setattr(targets, "MIN_SHORT_SIDE", 4)
    config = tiny_config(40, coarse_share=0.6, density={"opacity_reset_interval": 1750})
    whole = run(scene, tmp_path / "whole", config, scene.alpha_views)
    assert whole.counters["opacity_resets"] == 1
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
    with monkeypatch.context() as patch:
        interrupt_at(patch, call)
        with pytest.raises(KeyboardInterrupt):
            run(scene, tmp_path / "cut", config, scene.alpha_views)
    assert len(list((tmp_path / "cut").glob(PATTERN))) == min(2, call - 1)
    resumed = run(scene, tmp_path / "cut", config, scene.alpha_views)
    assert_same(whole, resumed)
    assert not resumed.warnings


@pytest.mark.parametrize("strategy", ["gradient", "mcmc", "original"])
def test_killed_at_twenty_random_steps_and_resumed_gives_the_same_bytes(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strategy: str
) -> None:
    density = {"strategy": strategy, "max_gaussians": 90, "prune_opacity": 0.1}
    config = tiny_config(60, density=density, dropout=0.3)
    write_npz(tmp_path / "whole.npz", run(scene, tmp_path / "whole", config).gaussians)
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
    calls = np.random.default_rng(11).permutation(np.arange(1, 61))[:20]
    done = 0
    for step in map(int, sorted(calls)):
        with monkeypatch.context() as patch:
            interrupt_at(patch, step - done)
            with pytest.raises(KeyboardInterrupt):
                run(scene, tmp_path, config)
        done = step - 1
        kept = [int(re.sub(r"\D", "", file.stem)) for file in tmp_path.glob(PATTERN)]
        assert max(kept, default=0) == done, f"killed in step {step}"
    write_npz(tmp_path / "resumed.npz", run(scene, tmp_path, config).gaussians)
    assert (tmp_path / "resumed.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()


def test_the_metrics_log_has_each_step_once_after_a_kill(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "logs" / "train.metrics.jsonl"
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(metrics_log, "SECONDS", 0.0)
    # A clock of its own: a fast machine has no second left after the first steps.
    looks = itertools.count()
    monkeypatch.setattr(session, "time", SimpleNamespace(monotonic=lambda: 0.1 * next(looks)))
    with monkeypatch.context() as patch:
        interrupt_at(patch, 23)
        with pytest.raises(KeyboardInterrupt):
            run(scene, tmp_path, logs=file.parent)
    with open(file, "a") as half:
        half.write('{"time": 1, "step": 2')
    result = run(scene, tmp_path, logs=file.parent)
    lines = metrics_log.read_metrics_log(file)
    assert [line.step for line in lines] == list(range(1, 41))
    assert lines[-1].share == 1
    assert lines[-1].psnr == result.curve.root[-1].psnr
    assert lines[-1].num_gaussians == len(result.gaussians)
    assert lines[-1].seconds_left == 0 < lines[5].seconds_left
    run(scene, tmp_path / "again", logs=file.parent)
    assert len(metrics_log.read_metrics_log(file)) == 40


def test_a_time_budget_passes_through_the_whole_schedule(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A clock of its own, a hundredth of a second a look: load has no part in it.
    looks = itertools.count()
    monkeypatch.setattr(session, "time", SimpleNamespace(monotonic=lambda: 0.01 * next(looks)))
    config = tiny_config(budget_minutes=2 / 60, coarse_share=0.5, density={"max_gaussians": 90})
    result = run(scene, tmp_path, config)
    assert 2.0 <= result.seconds < 2.05
    assert 195 <= result.steps <= 205
    assert len(result.curve.root) >= 20
    assert result.gaussians.sh_degree == 1
    assert len(result.gaussians) > 60, "density control took place"
    assert result.curve.root[-1].psnr > result.curve.root[0].psnr + 3
    steps = [record.step for record in result.curve.root]
    assert steps == sorted(steps)
    assert steps[-1] == result.steps


def test_resuming_from_an_older_step_gives_the_same_bits(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run(scene, tmp_path / "whole")
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
    with monkeypatch.context() as patch:
        interrupt_at(patch, 20)
        with pytest.raises(KeyboardInterrupt):
            run(scene, tmp_path / "cut")
    newest = max((tmp_path / "cut").glob(PATTERN))
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 1
    newest.write_bytes(bytes(data))
    said: list[str] = []
    resumed = run(scene, tmp_path / "cut", said=said)
    assert_same(whole, resumed)
    assert "damaged" in said[0]
    assert len(said) == 2 and "ms a step" in said[1]
    assert not resumed.warnings, "what happened to checkpoints is no part of the result"


def test_a_checkpoint_of_other_settings_is_not_used(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
    run(scene, tmp_path, seed=1)
    said: list[str] = []
    other = run(scene, tmp_path, seed=2, said=said)
    assert_same(other, run(scene, tmp_path / "clean", seed=2))
    assert any("other inputs" in line for line in said)


def test_threads_do_not_change_the_bits(scene: TinyScene, tmp_path: Path) -> None:
    """At up to 64 threads, in a scene of more ranges of Gaussians and tiles than most of them get,
    through density control, a rise of the SH degree and camera refinement."""
    views = []
    for view in scene.views:
        with Image.open(view.image) as small:
            picture = small.resize((4 * WIDTH, 4 * HEIGHT), Image.Resampling.BICUBIC)
        picture.save(tmp_path / view.name)
        at_size = resized(view, 4 * WIDTH, 4 * HEIGHT)
        views.append(replace(at_size, image=str(tmp_path / view.name)))
    large = replace(scene, initial=ball(8000, 7))
    config = tiny_config(16, density={"max_gaussians": 9000}, refine_poses=True)
    before = torch.get_num_threads()
    found = {
        threads: run(large, tmp_path / str(threads), config, views=views, threads=threads)
        for threads in (1, 2, 4, 16, 64)
    }
    one = found.pop(1)
    assert one.counters["max_gaussians"] > len(large.initial) and one.gaussians.sh_degree == 1
    write_npz(tmp_path / "1.npz", one.gaussians)
    for threads, other in found.items():
        assert_same(one, other)
        write_npz(tmp_path / "other.npz", other.gaussians)
        assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "other.npz").read_bytes(), threads
    assert torch.get_num_threads() == before


def test_ignored_pixels_have_no_influence(scene: TinyScene, tmp_path: Path) -> None:
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[8:20, 5:22] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    results = []
    for seed in (1, 2):
        views = []
        for index, view in enumerate(scene.views):
            picture = np.array(Image.open(view.image))
            noise = np.random.default_rng(seed).integers(0, 256, picture.shape, np.uint8)
            picture = np.where(mask[..., None] == 0, noise, picture)
            path = tmp_path / f"{seed}_{index}.png"
            Image.fromarray(picture).save(path)
            views.append(replace(view, image=str(path), mask=str(tmp_path / "mask.png")))
        results.append(run(scene, tmp_path / f"c{seed}", views=views))
    assert_same(*results)


def test_gaussians_behind_masks_vanish(scene: TinyScene, tmp_path: Path) -> None:
    """No colour loss constrains them, and other cameras would see them."""
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    views = [replace(view, mask=str(tmp_path / "mask.png")) for view in scene.views[:2]]
    seen = []
    for weight in (0.0, 0.1):
        never = {"stop_share": 0.0, "prune_opacity": 0.0}
        config = tiny_config(200, density=never, mask_loss_weight=weight)
        result = run(scene, tmp_path / f"c{weight}", config, views=views)
        renders = [render_view(result.gaussians, view) for view in views]
        halves = [
            (r.alpha[:, : WIDTH // 2].mean(), r.alpha[:, WIDTH // 2 :].mean()) for r in renders
        ]
        seen.append(np.mean(halves, 0))
    (left, left_right), (thinned, right) = seen
    assert thinned < 0.5 * left
    assert right == pytest.approx(left_right, rel=0.2)


def test_gains_compensate_for_different_exposures(scene: TinyScene, tmp_path: Path) -> None:
    gains = np.array([[0.5] * 3, [1.0] * 3] * (len(scene.views) // 2))
    views = []
    for index, (view, gain) in enumerate(zip(scene.views, gains, strict=True)):
        picture = np.rint(np.array(Image.open(view.image)) * gain).astype(np.uint8)
        Image.fromarray(picture).save(tmp_path / f"{index}.png")
        views.append(replace(view, image=str(tmp_path / f"{index}.png")))
    config = tiny_config(150)

    def trained(name: str, gains: NDArray[np.float64] | None) -> TrainResult:
        light = None if gains is None else [ViewLight(gain=tuple(gain)) for gain in gains]
        inputs = Inputs(views, scene.initial, scene.extent, light=light)
        return train(inputs, TrainingRun(config, tmp_path / name, seed=0, threads=1))

    with_gains, without = trained("a", gains), trained("b", None)
    assert with_gains.curve.root[-1].psnr > without.curve.root[-1].psnr + 3
    # The scene itself is the brighter photographs', as if there had been no other.
    plain = run(scene, tmp_path / "c", config)
    assert with_gains.curve.root[-1].psnr > plain.curve.root[-1].psnr - 1


def test_a_completely_masked_view_has_no_influence(scene: TinyScene, tmp_path: Path) -> None:
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(tmp_path / "mask.png")
    hidden = replace(scene.views[0], name="hidden", mask=str(tmp_path / "mask.png"))
    with_it = run(scene, tmp_path / "a", views=[*scene.views[:3], hidden, *scene.views[3:]])
    assert any("hidden" in text for text in with_it.warnings)
    assert_same(with_it, run(scene, tmp_path / "b"))
    with pytest.raises(UserError, match="masks"):
        run(scene, tmp_path / "c", views=[hidden])


def test_transparent_pixels_stay_empty(scene: TinyScene, tmp_path: Path) -> None:
    start = scene.initial.clone()
    start.opacity_logits.fill_(1.0)
    start.log_scales += 0.7
    result = train(
        Inputs(scene.alpha_views, start, scene.extent),
        TrainingRun(tiny_config(500, background="white"), tmp_path),
    )
    assert result.background == "white"
    for view in scene.alpha_views[:2]:
        alpha = np.asarray(Image.open(view.image))[..., 3]
        empty = alpha == 0
        assert empty.sum() > 50
        before = render_view(start, view).alpha[empty].mean()
        after = render_view(result.gaussians, view).alpha[empty].mean()
        assert after < 0.02 < before


def test_a_loss_that_is_not_finite_is_a_clear_error(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = make_backend()
    original = backend.l1_ssim
    monkeypatch.setattr(
        type(backend),
        "l1_ssim",
        lambda self, *args, **kwargs: replace(original(*args, **kwargs), loss=float("nan")),
    )
    with pytest.raises(UserError, match=r"not finite at step 1, view \d\.png"):
        run(scene, tmp_path)


def test_no_gaussian_left_is_a_clear_error(scene: TinyScene, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no Gaussian is left"):
        run(scene, tmp_path, tiny_config(40, density={"prune_opacity": 1.0}))


def test_gaussians_that_no_camera_sees_are_a_clear_error(scene: TinyScene, tmp_path: Path) -> None:
    far = scene.initial.clone()
    far.means += 1000.0
    with pytest.raises(UserError, match="no camera sees"):
        train(
            Inputs(scene.views, far, scene.extent),
            TrainingRun(tiny_config(), tmp_path, seed=0, threads=1),
        )


def test_nothing_to_train_is_a_clear_error(scene: TinyScene, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="0 views"):
        run(scene, tmp_path, views=[])


def test_more_gaussians_than_the_budget_are_thinned_with_a_warning(
    scene: TinyScene, tmp_path: Path
) -> None:
    result = run(scene, tmp_path, tiny_config(10, density={"max_gaussians": 20}))
    assert result.counters["max_gaussians"] <= 20
    assert any("budget" in warning for warning in result.warnings)
