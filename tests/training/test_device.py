"""Training on a GPU: as good as on the processor, the same bits at every run, and checkpoints of
one resume on the other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from pipeline.config.settled import TrainOptions
from pipeline.render.gpu import resident
from pipeline.scene.views import View
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop import session
from pipeline.training.loop.device_step import DeviceStep
from pipeline.training.loop.result import TrainResult
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun
from pipeline.training.transients import search
from tests.render.scenes import relative
from tests.tools import need_gpu
from tests.training.conftest import TinyScene, person_error, tiny_config

STEPS = 60


@pytest.fixture(autouse=True)
def gpu() -> None:
    need_gpu()


def options(device: str, **changes: object) -> TrainOptions:
    return tiny_config(STEPS, device=device, density={"max_gaussians": 90}, **changes)


def run(
    scene: TinyScene,
    folder: Path,
    config: TrainOptions,
    alpha: bool = False,
    said: list | None = None,
) -> TrainResult:
    views = scene.alpha_views if alpha else scene.views
    inputs = Inputs(views, scene.initial, scene.extent)
    log = [].append if said is None else said.append
    return train(inputs, TrainingRun(config, folder, seed=3, threads=1), log=log)


def assert_same(a: TrainResult, b: TrainResult) -> None:
    for name, tensor in a.gaussians.tensors().items():
        assert torch.equal(tensor, b.gaussians.tensors()[name]), name
    assert a.curve == b.curve
    assert a.counters == b.counters


@contextmanager
def killed_in(step: int) -> Iterator[None]:
    """Kills training in the middle of a step, with a checkpoint after the one before."""
    done, original = 0, DeviceStep.step

    def dying(self: DeviceStep, *args):
        nonlocal done
        done += 1
        if done == step:
            raise KeyboardInterrupt
        return original(self, *args)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(DeviceStep, "step", dying)
        yield


CASES = {
    "plain": {},
    "alpha": {"background": "random", "alpha_loss_weight": 0.1},
    "world's axes": {"means_learning_rate_unit": "scene_scale", "means_learning_rate": 1.6e-3},
    "poses": {"refine_poses": True},
    "original": {"density": "original"},
}


@pytest.mark.parametrize("case", CASES)
def test_quality_is_that_of_the_processor(scene: TinyScene, tmp_path: Path, case: str) -> None:
    changes = dict(CASES[case])
    strategy = changes.pop("density", "gradient")
    results = []
    for device in ("cpu", "gpu"):
        config = tiny_config(
            STEPS, device=device, density={"max_gaussians": 90, "strategy": strategy}, **changes
        )
        results.append(run(scene, tmp_path / device, config, alpha=case == "alpha"))
    cpu, gpu = results
    assert gpu.counters["opacity_resets"] == cpu.counters["opacity_resets"]
    assert len(gpu.curve.root) == len(cpu.curve.root)
    last = [result.curve.root[-1] for result in results]
    if strategy == "gradient":  # The other resets opacities near the end of so short a run.
        assert last[0].psnr > results[0].curve.root[0].psnr + 2
    assert last[1].psnr == pytest.approx(last[0].psnr, abs=0.5)
    # Before density control, whose choices a last bit can change.
    first = [result.curve.root[5] for result in results]
    assert first[1].loss == pytest.approx(first[0].loss, rel=1e-3)
    assert first[1].psnr == pytest.approx(first[0].psnr, abs=0.01)


@pytest.mark.parametrize("strategy", ["gradient", "mcmc"])
def test_two_runs_give_the_same_bits(scene: TinyScene, tmp_path: Path, strategy: str) -> None:
    """Also of a run whose steps need the processor, operator by operator."""
    config = tiny_config(
        STEPS if strategy == "gradient" else 20,
        device="gpu",
        density={"max_gaussians": 90, "strategy": strategy},
    )
    first, second = (run(scene, tmp_path / name, config) for name in ("a", "b"))
    assert_same(first, second)
    assert first.curve.root[-1].psnr > first.curve.root[0].psnr + 2


@pytest.mark.parametrize("step", [2, 13, 22, 41])
def test_a_killed_run_resumes_to_the_same_bits(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """Also if the arrays of pairs are too small again and again in the killed run, and if its
    results are read at other steps."""
    # Otherwise so short a run would record its curve, and read the results, after each step.
    monkeypatch.setattr(session, "CURVE_RECORDS", 4)
    config = options("gpu", background="random", coarse_share=0.4)
    whole = run(scene, tmp_path / "whole", config, alpha=True)
    monkeypatch.setattr(resident, "MIN_CAPACITY", 1)
    monkeypatch.setattr(resident, "PAIRS_PER_GAUSSIAN", 0)
    with killed_in(step):
        run(scene, tmp_path / "cut", config, alpha=True)
    assert_same(whole, run(scene, tmp_path / "cut", config, alpha=True))


@pytest.mark.parametrize(("before", "after"), [("cpu", "gpu"), ("gpu", "cpu")])
def test_a_checkpoint_of_one_device_resumes_on_another(
    scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str
) -> None:
    whole = run(scene, tmp_path / "whole", options(after))
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(session.TrainState, "record", stop_after(20))
        run(scene, tmp_path / "cut", options(before))
    said: list[str] = []
    resumed = run(scene, tmp_path / "cut", options(after), said=said)
    assert "from a checkpoint made with" in said[0]
    assert len(resumed.curve.root) == len(whole.curve.root)
    last, expected = resumed.curve.root[-1], whole.curve.root[-1]
    assert last.psnr == pytest.approx(expected.psnr, abs=0.5)
    assert resumed.curve.root[10].loss == pytest.approx(whole.curve.root[10].loss, rel=1e-2)
    assert relative(resumed.gaussians.means[:5], whole.gaussians.means[:5]) < 0.5


def stop_after(step: int):
    original = session.TrainState.record

    def record(state: session.TrainState) -> None:
        if state.step > step:
            raise KeyboardInterrupt
        original(state)

    return record


def test_who_passes_by_is_left_out_on_the_gpu(
    crowd: tuple[TinyScene, list[View]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images stay in the memory of the device: those with other masks are copied again."""
    monkeypatch.setattr(search, "MIN_EPOCHS", 5)
    scene, views = crowd
    errors = {}
    for wanted in ("find", "none"):
        density = {"max_gaussians": 200}
        config = tiny_config(120, device="gpu", transients=wanted, density=density)
        inputs = Inputs(views, scene.initial, scene.extent)
        result = train(inputs, TrainingRun(config, tmp_path / wanted, seed=3, threads=1))
        assert (result.transients or {}).keys() >= ({"3.png"} if wanted == "find" else set())
        errors[wanted] = person_error(result, scene)
    assert errors["find"] < 0.5 * errors["none"]
