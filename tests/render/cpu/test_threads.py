"""Results do not depend on the number of threads, concurrent callers or forks."""

from __future__ import annotations

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pipeline.render import ImageGradients, RasterOptions, make_backend
from pipeline.render.types import AdamRates, AlphaChangeLoss, FrameMoments, Moments, ShAdam
from tests.render.scenes import camera, random_scene, random_surroundings
from tests.render.updates import made_adam, moments_of

COUNT = 40_000
GRADIENTS = (
    *("means", "log_scales", "quats", "opacity_logits", "sh", "means2d"),
    "colors",
)


def draw(threads: int) -> bytes:
    """The bytes of a rendered view and its gradients."""
    backend, options = make_backend("cpu"), RasterOptions(threads=threads)
    fwd = backend.forward(*random_scene(3, 4000), camera(203, 151), options)
    gradients = backend.backward(fwd, torch.ones_like(fwd.color))
    tensors = (fwd.color, gradients.means, gradients.sh, gradients.log_scales)
    return b"".join(tensor.numpy().tobytes() for tensor in tensors)


def every_operator(threads: int) -> dict[str, Tensor]:
    """The results of every operator on a scene with more ranges than 64 threads, by name."""
    backend, cam = make_backend("cpu"), camera(403, 301)
    scene = [tensor.clone() for tensor in random_scene(3, COUNT)]
    means, log_scales, quats, opacity_logits, sh = scene
    draws = torch.Generator().manual_seed(1)
    fwd = backend.forward(*scene, cam, RasterOptions(threads=threads))
    found = {"color": fwd.color, "alpha": fwd.alpha, "radii": fwd.radii}
    found |= {"depth": fwd.depth, "median": fwd.median_depth}
    target = (255 * torch.rand(fwd.color.shape, generator=draws)).to(torch.uint8)
    mask = torch.rand(fwd.alpha.shape, generator=draws) < 0.2
    loss = backend.l1_ssim(fwd.color, target, 0.2, mask, 2.5, threads)
    found |= {"loss": torch.tensor([loss.loss, loss.error, loss.ssim]), "d_color": loss.grad}

    for name, shape in (("uniform", (3,)), ("shading", fwd.color.shape)):
        factor = torch.rand(shape, generator=draws)
        lit = backend.l1_ssim(fwd.color, target, 0.2, mask, threads=threads, factor=factor)
        found |= {name: lit.grad, f"{name} loss": torch.tensor([lit.loss, lit.squared_error])}

    around = random_surroundings(301, 403, front=True, correction=True)
    change = AlphaChangeLoss(weight=1.0, fade=0.02, growth=0.25)
    found["composed"] = backend.compose(around, fwd.color, fwd.alpha, threads)
    composed = backend.compose_backward(around, fwd.alpha, loss.grad, change, threads)
    found |= dict(zip(("d_composed", "d_alpha"), composed, strict=True))

    sh_moments = Moments(torch.zeros_like(sh).bfloat16(), torch.zeros_like(sh[..., :1]))
    last = torch.zeros(COUNT, dtype=torch.int32)
    every = {"colors": True, "camera": True}
    g = backend.backward(fwd, loss.grad, fwd.alpha, fwd.median_depth, **every)
    found |= {f"d_{name}": getattr(g, name) for name in GRADIENTS}
    assert g.camera is not None
    found |= {f"camera.{name}": tensor for name, tensor in vars(g.camera).items()}
    found["observed"] = observed = torch.rand(2, COUNT, generator=draws)
    statistics = observed.clone()
    backend.observe_gradients(fwd, g, *observed, threads)
    make_backend("reference").observe_gradients(fwd, g, *statistics)
    assert torch.allclose(observed, statistics, rtol=1e-6)
    sh_adam = ShAdam(sh_moments, last, AdamRates((1e-2, 1e-3), 3))
    backend.backward(fwd, loss.grad, sh_adam=sh_adam)
    found |= {"sh": sh, "sh.first": sh_moments.exp_avg, "sh.second": sh_moments.exp_avg_sq}

    frames = FrameMoments(Moments(*torch.ones(2, COUNT, 3)), Moments(*torch.ones(2, COUNT, 3)))
    rates = AdamRates((1e-2, 1e-3), 3)
    backend.frame_adam(means, quats, log_scales, g.means, g.quats, frames, rates, threads)
    found |= {"means": means, "quats": quats, "frames": frames.rotations.exp_avg_sq}
    dense, rows = (
        Moments(*torch.ones(2, COUNT)),
        Moments(torch.ones(COUNT, 3), torch.ones(COUNT, 1)),
    )
    backend.adam_step(opacity_logits, g.opacity_logits, dense, AdamRates(1e-2, 3), threads)
    backend.adam_step(log_scales, g.log_scales, rows, AdamRates(1e-2, 3), threads)
    found |= {"opacity_logits": opacity_logits, "log_scales": log_scales}

    parameters = means.clone(), log_scales.clone(), quats.clone(), *(t.clone() for t in scene[3:])
    adam, statistics = made_adam(parameters), torch.zeros(2, COUNT)
    backend.update(
        fwd,
        parameters,
        ImageGradients(loss.grad),
        adam=adam,
        statistics=tuple(statistics),
        colors=True,
    )
    changed = (*parameters, statistics, *moments_of(adam))
    found |= {f"updated {k}": tensor for k, tensor in enumerate(changed)}
    return found


def test_every_operator_has_the_same_bits_at_1_to_64_threads() -> None:
    """Most of the threads wait for a processor, so that ranges run in many orders."""
    one = every_operator(1)
    assert all(bool(tensor.isfinite().all()) for tensor in one.values())
    for threads in (2, 4, 16, 64):
        found = every_operator(threads)
        assert [name for name in one if not torch.equal(one[name], found[name])] == [], threads


@pytest.mark.parametrize("threads", [2, 8, 300])
def test_more_threads_than_processors_change_nothing(threads: int) -> None:
    expected = draw(1)
    assert all(draw(threads) == expected for _ in range(5))


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the system lists no threads")
def test_threads_without_work_sleep() -> None:
    """They look out for the next loop for some milliseconds only."""
    draw(8)
    deadline = time.monotonic() + 20
    while "R" in thread_states():
        assert time.monotonic() < deadline, "threads of the kernels keep a processor busy"
        time.sleep(0.05)


def thread_states() -> list[str]:
    """The states of the other threads of this process: R while one runs or waits for a
    processor."""
    tasks, own = Path("/proc/self/task"), str(threading.get_native_id())
    stats = [(task / "stat").read_text() for task in tasks.iterdir() if task.name != own]
    assert len(stats) >= 7
    return [stat.rpartition(")")[2].split()[0] for stat in stats]


def test_callers_on_several_threads_at_once_change_nothing() -> None:
    """One caller uses the worker threads; the others run their loops on their own thread."""
    expected = draw(1)
    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(draw, [2] * 24)) == {expected}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_neither_hangs_nor_differs() -> None:
    expected = draw(2)
    child = os.fork()
    if child == 0:
        torch.set_num_threads(1)  # torch's own do not survive a fork
        os._exit(0 if draw(2) == expected else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
