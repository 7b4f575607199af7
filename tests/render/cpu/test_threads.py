"""Results do not depend on the number of threads, concurrent callers or forks."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from pipeline.render import RasterOptions, make_backend
from tests.render.scenes import camera, random_scene


def draw(threads: int) -> bytes:
    """The bytes of a rendered view and its gradients."""
    backend, options = make_backend("cpu"), RasterOptions(threads=threads)
    fwd = backend.forward(*random_scene(3, 4000), camera(203, 151), options)
    gradients = backend.backward(fwd, torch.ones_like(fwd.color))
    tensors = (fwd.color, gradients.means, gradients.sh, gradients.log_scales)
    return b"".join(tensor.numpy().tobytes() for tensor in tensors)


@pytest.mark.parametrize("threads", [2, 8, 300])
def test_more_threads_than_processors_change_nothing(threads: int) -> None:
    expected = draw(1)
    assert all(draw(threads) == expected for _ in range(5))


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
