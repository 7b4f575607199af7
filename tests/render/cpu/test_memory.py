"""The memory that kernels keep for later calls is limited, and changes no result."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pipeline.render import Backend, RasterOptions, make_backend
from tests.render.scenes import camera, random_scene

# Of the images of a view of 1600x1200 pixels, at least.
IMAGES_MB = 30


@pytest.fixture
def backend() -> Iterator[Backend]:
    backend = make_backend("cpu")
    yield backend
    backend.save_memory(False)


def gradient(backend: Backend) -> torch.Tensor:
    rendered = backend.forward(*random_scene(3, 4000), camera(1600, 1200), RasterOptions())
    return backend.backward(rendered, torch.ones_like(rendered.color)).means


def resident_mb() -> float:
    """Memory of the process without files."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("RssAnon"))
    return int(line.split()[1]) / 2**10


def test_results_do_not_depend_on_the_memory_that_is_kept(backend: Backend) -> None:
    expected = gradient(backend)
    backend.save_memory(True)
    assert torch.equal(gradient(backend), expected)
    backend.release_memory()
    assert torch.equal(gradient(backend), expected)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_kept_memory_can_be_returned(backend: Backend) -> None:
    gradient(backend)
    kept = resident_mb()
    backend.release_memory()
    assert kept - resident_mb() > IMAGES_MB / 2
