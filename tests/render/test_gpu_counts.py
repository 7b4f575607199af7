"""The waits, dispatches and bytes of a training step on a GPU. They are the same on each card, and
hold the step to what it was made for where no card can time it."""

from __future__ import annotations

import pytest
import torch

from benchmarks.gpu_counts import counted_steps
from pipeline.render import make_backend
from pipeline.render.calibration import StepScene
from pipeline.render.gpu import kernels, layout, rasterise, resident
from pipeline.render.gpu.backend import GpuBackend
from pipeline.render.gpu.counts import Counts
from pipeline.render.gpu.kernels import Use
from tests.render.scenes import camera, random_scene
from tests.tools import need_gpu

STEPS, GAUSSIANS = 20, 1500


def counted(steps: int) -> Counts:
    need_gpu()
    backend = make_backend("gpu")
    assert isinstance(backend, GpuBackend)
    target = torch.zeros(48, 64, 3, dtype=torch.uint8)
    scene = StepScene(random_scene(1, GAUSSIANS), camera(64, 48), target)
    return counted_steps(backend, scene, steps)[0]


@pytest.fixture(scope="module")
def counts() -> Counts:
    return counted(STEPS)


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
    floats = {"sh": 48, "geometry": 11, "first sh": 24, "second sh": 16, "moments": 20,
              "statistics": 2}  # fmt: skip
    for name, width in floats.items():
        once = 4 * width * GAUSSIANS * STEPS
        reads = 2 if name in ("sh", "geometry") else 1  # The projection reads parameters.
        assert (traffic.read[name], traffic.written[name]) == (reads * once, once), name
    assert not traffic.read["gradients"] + traffic.written["gradients"]


def test_images_are_moved_few_times(counts: Counts) -> None:
    """The loss and its gradient read the image once. A default step has no alpha and depths, and no
    gradients on them."""
    traffic = counts.traffic
    assert traffic is not None
    pixel = 48 * 64 * STEPS
    assert traffic.written["image"] == traffic.written["gradient of the image"] == 12 * pixel
    assert traffic.read["image"] == 24 * pixel and traffic.read["a training image"] == 3 * pixel
    assert traffic.read["gradient of the image"] == 12 * pixel
    planes = {"alpha and depths", "zeros", "gradients of alpha and depth", "derivatives of SSIM"}
    assert not planes & (traffic.read.keys() | traffic.written.keys())


def test_the_pairs_of_the_scene_are_counted_not_their_room(counts: Counts) -> None:
    traffic = counts.traffic
    assert traffic is not None and counts.pairs is not None
    assert GAUSSIANS < counts.pairs < resident.MIN_CAPACITY
    assert traffic.written["Gaussians of pairs"] == 4 * counts.pairs * STEPS
    expected = layout.SLOT_BYTES * counts.pairs * STEPS
    assert traffic.written["slots of gradients"] == traffic.read["slots of gradients"] == expected


def test_the_bands_of_an_image_count_it_once(
    monkeypatch: pytest.MonkeyPatch, counts: Counts
) -> None:
    monkeypatch.setattr(rasterise, "TILES_OF_BAND", 4)
    bands = counted(1)
    assert bands.traffic is not None and counts.traffic is not None
    assert bands.dispatches == counts.dispatches / STEPS + 4
    assert bands.traffic.total == pytest.approx(counts.traffic.total / STEPS, rel=1e-4)


def test_uses_of_buffers_are_read_from_the_kernels() -> None:
    found = kernels.uses("update_gaussians")
    assert found["gradients"] == Use(read=False, written=True)
    assert found["moments"] == found["geometry"] == Use(read=True, written=True)
    assert found["exp_avg"] == found["sh"] == Use(read=True, written=True)
    assert found["slots"] == Use(read=True, written=False)
    forward, backward = kernels.uses("compose.compose"), kernels.uses("compose.backward")
    assert forward["front"] == Use(read=True, written=False)
    assert backward["front"] == forward["d_alpha"] == Use(read=False, written=False)
    assert backward["d_alpha"] == Use(read=False, written=True)
    assert kernels.uses("project")["dropped"] == Use(read=True, written=True)  # atomic
