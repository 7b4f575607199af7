"""Density control of Gaussians in the memory of a device: the same bits as in the processor's, and
few bytes between the two."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.config.density import Gradient
from pipeline.config.settled import TrainOptions
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.counts import Counts
from pipeline.render.gpu.device import Gpu
from pipeline.render.resident import Optimised, Part
from pipeline.scene.views import View
from pipeline.splats import rows
from pipeline.splats.gaussians import Geometry
from pipeline.splats.skybox import FILL_OPACITY
from pipeline.training.data.inputs import Inputs
from pipeline.training.density import Update, floaters
from pipeline.training.loop import device_step, session
from pipeline.training.loop.device_step import DeviceStep
from pipeline.training.loop.train import train
from pipeline.training.loop.trainer import Trainer
from pipeline.training.run import TrainingRun
from pipeline.training.transients import search
from pipeline.training.transients.evidence import ReducedPhotographs
from tests.tools import need_gpu
from tests.training.conftest import TinyScene, tiny_config

STEPS, VIEWS = 60, 30
Arrays = dict[str, np.ndarray]


class Device:
    """A GPU whose trainings are recorded.

    Attributes:
        arrays: The arrays of a checkpoint after the last step of the last training.
        applied: Whether density control refined the set, and whether it reset opacities, each time.
    """

    def __init__(self, patch: pytest.MonkeyPatch, subgroups: bool) -> None:
        self.backend = GpuBackend()
        self.backend.gpu = Gpu(subgroups=subgroups)
        if self.backend.gpu.subgroups != subgroups:
            pytest.skip(f"{self.backend.gpu.adapter} has no subgroups")
        self.arrays: Arrays = {}
        self.applied: list[tuple[bool, bool]] = []
        finish, apply = Trainer.finish, DeviceStep.apply

        def recorded_finish(trainer: Trainer) -> None:
            trainer.fetch()
            self.arrays = {k: v.copy() for k, v in trainer.state.arrays().items()}
            finish(trainer)

        def recorded_apply(step: DeviceStep, update: Update) -> None:
            self.applied.append((update.refinement is not None, update.opacity_reset))
            apply(step, update)

        patch.setattr(Trainer, "finish", recorded_finish)
        patch.setattr(DeviceStep, "apply", recorded_apply)

    def train(self, inputs: Inputs, config: TrainOptions, folder: Path) -> Arrays:
        self.applied.clear()
        train(inputs, TrainingRun(config, folder, seed=3, threads=1), backend=self.backend)
        return self.arrays


def wrong_rows(tensors: dict[str, Tensor], count: int) -> dict[str, Tensor]:
    """Tensors without values, which nobody may read before they are fetched."""
    found = rows.new_rows(tensors, count)
    for tensor in found.values():
        tensor.fill_(math.nan if tensor.is_floating_point() else -1)
    return found


@pytest.fixture(params=[True, False], ids=["subgroups", "without"])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Device:
    need_gpu()
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 1e9)
    monkeypatch.setattr(device_step, "new_rows", wrong_rows)
    return Device(monkeypatch, request.param)


def fetched(step: DeviceStep) -> None:
    """Copy all tensors to the processor. The statistics are those of a step before."""
    gaussians, adam = step.state.gaussians, step.state.adam
    statistics = torch.zeros(2, len(gaussians))
    step.training.store(
        Optimised(gaussians.tensors(), adam.first, adam.second, adam.last, *statistics)
    )


def apply_on_the_processor(step: DeviceStep, update: Update) -> None:
    decided = Geometry(**{k: v.clone() for k, v in update.geometry.tensors().items()})
    fetched(step)
    step.state.apply(replace(update, geometry=decided), 1)
    step.training.load(step._optimised())


def raise_on_the_processor(step: DeviceStep, degree: int) -> None:
    fetched(step)
    step.state.gaussians = step.state.gaussians.with_sh_degree(degree)
    step.state.adam.resize_bands(degree)
    step.training.load(step._optimised())


# Opacities are reset with a densification, or between two.
CASES = {
    "reset with splits": {"opacity_reset_interval": 1750},
    "reset alone": {"opacity_reset_interval": 2000},
    "original": {"strategy": "original"},
}


@pytest.mark.parametrize("case", CASES)
def test_the_device_does_what_the_processor_decides(
    scene: TinyScene, tmp_path: Path, device: Device, case: str
) -> None:
    """Gaussians, moments and statistics are those of a training that copies all of them to the
    processor and back whenever density control or a higher SH degree changes them: also with an
    appearance, and with Gaussians that steps do not change."""
    initial = scene.initial.clone()
    initial.opacity_logits[:3] = float(np.log(FILL_OPACITY / (1 - FILL_OPACITY)))
    embeddings = np.random.default_rng(0).normal(size=(len(scene.views), 2))
    inputs = Inputs(scene.views, initial, scene.extent, embeddings=embeddings)
    density = {"max_gaussians": 90, **CASES[case]}
    changes = {"sh_degree": 2, "sh_degree_interval": 2500, "background": "fill"}
    config = tiny_config(STEPS, device="gpu", density=density, **changes)
    found = device.train(inputs, config, tmp_path / "device")
    applied = list(device.applied)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DeviceStep, "apply", apply_on_the_processor)
        patch.setattr(DeviceStep, "raise_sh_degree", raise_on_the_processor)
        expected = device.train(inputs, config, tmp_path / "processor")
    assert found.keys() == expected.keys()
    for name, array in found.items():
        np.testing.assert_array_equal(array, expected[name], err_msg=name)
    assert (case == "reset with splits", True) in applied and (True, False) in applied
    assert found["parameter.sh"].shape[1] == 9
    if case != "original":  # It splits them.
        assert (found["second.sh"] > 1e10).sum() == 3 * 9


@pytest.mark.parametrize("device", [False], indirect=True, ids=["without"])
def test_searches_for_transients_see_the_gaussians_of_the_device(
    crowd: tuple[TinyScene, list[View]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    device: Device,
) -> None:
    """They find what they find in Gaussians that were copied to the processor."""
    monkeypatch.setattr(search, "MIN_EPOCHS", 5)
    scene, views = crowd
    inputs = Inputs(views, scene.initial, scene.extent)
    density = {"max_gaussians": 160}
    config = tiny_config(60, device="gpu", transients="find", density=density)
    found = device.train(inputs, config, tmp_path / "device")
    monkeypatch.setattr(DeviceStep, "lend", lambda step: step.fetch(Part.PARAMETERS))
    expected = device.train(inputs, config, tmp_path / "processor")
    for name, array in found.items():
        np.testing.assert_array_equal(array, expected[name], err_msg=name)
    assert found["transients.found"].any()


def many_views(scene: TinyScene) -> list[View]:
    """The views again and again: drop-out, which only operators do, is for few."""
    views = [scene.views[index % len(scene.views)] for index in range(VIEWS)]
    return [replace(view, name=f"{index}.png") for index, view in enumerate(views)]


@pytest.mark.parametrize("device", [False], indirect=True, ids=["without"])
@pytest.mark.parametrize("searched", [False, True])
def test_a_default_run_hardly_copies_gaussians(
    scene: TinyScene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    device: Device,
    searched: bool,
) -> None:
    """Before its end, a run copies no colours and no moments to the processor. Density control,
    floaters and transients need the geometry only."""
    copied: list[Counter[str]] = []
    searches: list[torch.Size] = []
    finish, search_once = Trainer.finish, search.Transients.search

    def counted_finish(trainer: Trainer) -> None:
        copied.append(Counter(device.backend.gpu.counts.downloaded))
        finish(trainer)

    def counted_search(transients: search.Transients, photographs: ReducedPhotographs) -> Tensor:
        searches.append(photographs.shown(0).sh.shape)
        return search_once(transients, photographs)

    monkeypatch.setattr(Trainer, "finish", counted_finish)
    monkeypatch.setattr(search.Transients, "search", counted_search)
    depths = None
    if searched:
        for module in (search, floaters):
            monkeypatch.setattr(module, "MIN_EPOCHS", 5)
        depths = np.ones(VIEWS)
    inputs = Inputs(many_views(scene), scene.initial, scene.extent, empty_depths=depths)
    config = TrainOptions(
        steps=200, device="gpu", density=Gradient(max_gaussians=120), transients="find"
    )
    device.backend.gpu.counts = Counts()
    device.train(inputs, config, tmp_path)
    (found,) = copied
    assert len(device.applied) > 10 and found["geometry"] > 10 * 44 * len(scene.initial)
    assert len(searches) == (2 if searched else 0)
    assert not {"sh", "moments", "first sh", "second sh"} & found.keys()
