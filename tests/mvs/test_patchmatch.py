"""PatchMatch stereo: its cost equals the reference, and it finds planes that are known exactly."""

from __future__ import annotations

import ctypes
import subprocess
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.mvs import patchmatch as kernel
from pipeline.mvs.estimate import (
    StereoOptions,
    depth_of,
    enlarged,
    estimate_planes,
    normals_of,
)
from pipeline.mvs.patchmatch import CostOptions, Picture, SearchOptions, patchmatch
from pipeline.runtime import targets
from pipeline.runtime.native import compiler
from pipeline.runtime.targets import Variant
from tests.mvs import planar
from tests.mvs.reference import pixel_cost
from tests.tools import unsupported

RANGE = (2.0, 12.0)
COST = CostOptions()
NO_POINTS = np.zeros((0, 3))


def matching_cost(reference, sources, planes, depths, options=COST) -> np.ndarray:
    search = SearchOptions(depths, iterations=0, num_random=0, first_step=0.0, seed=0)
    return patchmatch(reference, sources, planes, search, options)[1]


def some_planes(count: int) -> np.ndarray:
    """(N, 3) planes near the true one and far from it, some outside the sources."""
    rng = np.random.default_rng(5)
    near = rng.normal([0.2, 0.001, -0.001], [0.03, 0.0005, 0.0005], (count, 3))
    near[::3, 1:] *= 2
    return near


def assert_costs_equal_the_reference() -> None:
    reference, *sources = planar.pictures(40, 30)
    valid = reference.valid.copy()
    valid[10:14, 20:26] = False
    reference = replace(reference, valid=valid)
    options = CostOptions(num_best=2)
    pixels = [(0, 0), (39, 29), (39, 0), (7, 13), (19, 11), (22, 15), (30, 3), (1, 28)]
    for plane in some_planes(12):
        planes = np.broadcast_to(plane[:, None, None], (3, 30, 40)).astype(np.float32)
        found = matching_cost(reference, sources, planes, (1.0, 100.0), options)
        assert (found[~valid] == 2).all()
        for column, row in pixels:
            expected = pixel_cost(reference, sources, column, row, tuple(plane), options)
            assert found[row, column] == pytest.approx(expected, abs=3e-3)


def test_the_cost_equals_the_reference():
    assert_costs_equal_the_reference()


@pytest.mark.parametrize("target", targets.TARGETS, ids=lambda target: target.name)
def test_the_cost_of_every_target_equals_the_reference(tmp_path, monkeypatch, target):
    if target.missing:
        unsupported(f"this processor cannot run {target.name}")
    library = tmp_path / "stereo.so"
    sources = sorted(str(path) for path in kernel.LIBRARY.sources.glob("*.cpp"))
    flags = kernel.LIBRARY.flags_for(Variant(target))
    subprocess.run(
        [*compiler(), *flags, "-Werror", "-shared", *sources, "-o", str(library)], check=True
    )
    monkeypatch.setattr(kernel, "_library", lambda: ctypes.CDLL(str(library)))
    assert_costs_equal_the_reference()


def test_the_true_plane_has_the_lowest_cost():
    reference, *sources = planar.pictures()
    truth = planar.true_planes(reference.view)
    inside = np.s_[8:-8, 8:-8]
    best = matching_cost(reference, sources, truth, RANGE)[inside]
    assert np.median(best) < 0.02
    for change in (0.97, 1.03):
        other = truth * np.array([change, 1, 1], np.float32)[:, None, None]
        cost = matching_cost(reference, sources, other, RANGE)[inside]
        assert (cost > best).mean() > 0.98
    tilted = truth * np.array([1, 0, 0], np.float32)[:, None, None]
    cost = matching_cost(reference, sources, tilted, RANGE)[inside]
    assert (cost > best).mean() > 0.9


def test_a_slanted_plane_is_found_from_nothing():
    reference, *sources = planar.pictures(128, 96)
    planes, costs = estimate_planes(reference, sources, NO_POINTS, 0, StereoOptions())
    truth = planar.depth(reference.view)
    error = np.abs(depth_of(planes) / truth - 1)[8:-8, 8:-8]
    assert np.median(error) < 0.002 and (error < 0.01).mean() > 0.97
    assert np.median(costs) < 0.02
    expected = -planar.NORMAL / np.linalg.norm(planar.NORMAL)
    cosine = normals_of(planes, reference.view)[8:-8, 8:-8] @ expected
    assert np.degrees(np.arccos(np.median(cosine))) < 3


def test_enlarged_planes_are_those_of_the_same_surface():
    camera = planar.view(planar.CENTRES[0], 50, 40)
    small = planar.true_planes(planar.view(planar.CENTRES[0], 50, 40))
    large = replace(camera, width=100, height=80, fx=2 * camera.fx, fy=2 * camera.fy)
    large = replace(large, cx=2 * camera.cx, cy=2 * camera.cy)
    np.testing.assert_allclose(enlarged(small, large), planar.true_planes(large), rtol=2e-5)


def test_results_do_not_depend_on_what_runs_beside():
    reference, *sources = planar.pictures(64, 48)

    def estimate(seed: int) -> bytes:
        planes, costs = estimate_planes(reference, sources, NO_POINTS, seed, StereoOptions())
        return planes.tobytes() + costs.tobytes()

    alone = [estimate(seed) for seed in range(3)]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(estimate, range(3))) == alone
    assert len(set(alone)) == 3


def test_excluded_pixels_have_no_plane():
    reference, *sources = planar.pictures(48, 40)
    valid = np.zeros(reference.grey.shape, bool)
    valid[10:30, 5:40] = True
    planes, costs = estimate_planes(
        replace(reference, valid=valid), sources, NO_POINTS, 0, StereoOptions()
    )
    assert ((planes[0] > 0) == valid).all() and (costs[~valid] == 2).all()


def test_without_sources_or_pixels_there_is_no_depth():
    reference, *sources = planar.pictures(20, 16)
    nothing = replace(reference, valid=np.zeros_like(reference.valid))
    for picture, others in ((reference, []), (nothing, sources)):
        planes, _ = estimate_planes(picture, others, NO_POINTS, 0, StereoOptions())
        assert not depth_of(planes).any()


@settings(max_examples=25, derandomize=True, deadline=None)
@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    other=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    kind=st.sampled_from(["noise", "flat", "behind"]),
    points=st.sampled_from(["none", "one", "line", "same", "wild"]),
    seed=st.integers(0, 9),
)
def test_any_sizes_and_points_give_finite_planes(size, other, kind, points, seed):
    rng = np.random.default_rng(seed)

    def random_picture(centre, size) -> Picture:
        camera = planar.view(centre, *size)
        shape = size[::-1]
        grey = rng.integers(0, 256, shape) if kind == "noise" else np.full(shape, 7)
        return Picture(camera, grey.astype(np.uint8), rng.random(shape) < 0.8)

    reference = random_picture((0, 0, 0), size)
    sources = [random_picture((0.3, 0, 0), other), random_picture((0, 0.2, 0.1), size)]
    if kind == "behind":
        sources.append(random_picture((0.0, 0.0, 40.0), other))
    xyz = {
        "none": NO_POINTS,
        "one": np.array([[0.1, 0.1, 4.0]]),
        "line": np.linspace([-1, 0, 4], [1, 0, 5], 20),
        "same": np.full((12, 3), 4.0),
        "wild": rng.normal(0, 10, (30, 3)),
    }[points]
    planes, costs = estimate_planes(reference, sources, xyz, seed, StereoOptions())
    assert np.isfinite(planes).all() and np.isfinite(costs).all()
    assert ((costs >= 0) & (costs <= 2)).all() and (planes[0] >= 0).all()
    assert np.isfinite(normals_of(planes, reference.view)).all()
