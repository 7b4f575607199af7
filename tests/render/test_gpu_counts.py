"""The waits, dispatches and bytes of a training step on a GPU. They are the same on each card, and
hold the step to what it was made for where no card can time it."""

from __future__ import annotations

import pytest
import torch

from benchmarks.gpu_counts import counted_steps
from pipeline.render import make_backend
from pipeline.render.calibration import StepScene
from pipeline.render.gpu import kernels, resident
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.counts import Counts
from pipeline.render.gpu.kernels import Use
from tests.render.scenes import camera, random_scene
from tests.tools import need_gpu

STEPS, GAUSSIANS = 20, 1500


@pytest.fixture(scope="module")
def counts() -> Counts:
    need_gpu()
    backend = make_backend("gpu")
    assert isinstance(backend, GpuBackend)
    target = torch.zeros(48, 64, 3, dtype=torch.uint8)
    scene = StepScene(random_scene(1, GAUSSIANS), camera(64, 48), target)
    return counted_steps(backend, scene, STEPS)[0]


def test_steps_do_not_wait_for_the_device(counts: Counts) -> None:
    """Only the results of all steps are read."""
    assert counts.waits == 1


def test_a_step_takes_few_dispatches(counts: Counts) -> None:
    assert counts.dispatches <= 26 * STEPS
    assert counts.copies == 0
    assert counts.submissions <= 2 * STEPS


def test_parameters_and_moments_are_read_and_written_once(counts: Counts) -> None:
    traffic = counts.traffic
    assert traffic is not None
    floats = {"sh": 48, "geometry": 11, "first sh": 48, "second sh": 48, "moments": 20,
              "statistics": 2}  # fmt: skip
    for name, width in floats.items():
        once = 4 * width * GAUSSIANS * STEPS
        reads = 2 if name in ("sh", "geometry") else 1  # The projection reads parameters.
        assert (traffic.read[name], traffic.written[name]) == (reads * once, once), name
    assert not traffic.read["gradients"] + traffic.written["gradients"]


def test_pairs_have_little_room(counts: Counts) -> None:
    """The kernels of pairs run over the room of their arrays, not over what is allocated."""
    traffic = counts.traffic
    assert traffic is not None
    pairs = traffic.written["Gaussians of pairs"] / 4 / STEPS
    assert pairs <= max(resident.MIN_CAPACITY, 4 * GAUSSIANS)


def test_uses_of_buffers_are_read_from_the_kernels() -> None:
    found = kernels.uses("update_gaussians")
    assert found["gradients"] == Use(read=False, written=True)
    assert found["moments"] == found["geometry"] == Use(read=True, written=True)
    assert found["exp_avg"] == found["sh"] == Use(read=True, written=True)
    assert found["slots"] == Use(read=True, written=False)
    forward, backward = kernels.uses("loss.forward"), kernels.uses("loss.backward")
    assert forward["derivatives"] == Use(read=False, written=True)
    assert backward["derivatives"] == Use(read=True, written=False)
    assert forward["gradient"] == Use(read=False, written=False)
    assert kernels.uses("project")["dropped"] == Use(read=True, written=True)  # atomic
