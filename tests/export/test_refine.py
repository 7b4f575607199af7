"""Merged Gaussians are refined until they look like those that they replace."""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.export.refine import refined
from pipeline.export.selection import psnr_against_all
from pipeline.render import RasterOptions
from pipeline.splats.arrays import GaussianArrays
from pipeline.splats.levels import merged_to
from tests.reporting.made import gaussians, ring

VIEWS = ring(12, width=60, height=45)
OPTIONS = RasterOptions(near=0.03)


def psnr(some: GaussianArrays, everything: GaussianArrays) -> float:
    """Over views that refining has not seen."""
    tests = [dataclasses.replace(view, is_test=True) for view in VIEWS[::3]]
    found = psnr_against_all(everything, some, tests, OPTIONS)
    assert found is not None
    return found


def test_views_that_were_not_refined_look_more_like_those_of_all() -> None:
    everything = gaussians(400, degree=0)
    merged = merged_to(everything, 200, np.ones(400))
    before = {name: values.copy() for name, values in merged.arrays().items()}
    training = [view for index, view in enumerate(VIEWS) if index % 3]
    found = refined(merged, everything, training, OPTIONS, steps=400)
    assert (len(found), found.sh_degree) == (200, 0)
    assert psnr(found, everything) > psnr(merged, everything) + 1
    for name, values in merged.arrays().items():
        np.testing.assert_array_equal(values, before[name])


def test_gaussians_that_already_look_right_stay_so() -> None:
    everything = gaussians(100)
    found = refined(everything, everything, VIEWS, OPTIONS, steps=50)
    assert psnr(found, everything) > 40
