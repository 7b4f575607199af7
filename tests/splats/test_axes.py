"""Gaussians in other axes: the same ellipsoids and colours, seen in a mirrored world."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from pipeline.render.reference import rotation_from_quat, sh_basis
from pipeline.splats.arrays import collect
from pipeline.splats.axes import Flipped
from pipeline.splats.gaussians import Gaussians
from tests.splats.samples import sample


def covariances(gaussians: Gaussians) -> torch.Tensor:
    axes = (
        rotation_from_quat(gaussians.quats.double()) * gaussians.log_scales.double().exp()[:, None]
    )
    return axes @ axes.transpose(1, 2)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("signs", itertools.product((1, -1), repeat=3))
def test_ellipsoids_and_colours_are_mirrored(signs, degree) -> None:
    gaussians = sample(20, degree)
    flipped = Gaussians.from_arrays(collect(Flipped(gaussians, signs)))
    mirror = torch.diag(torch.tensor(signs, dtype=torch.float64))
    assert torch.equal(flipped.means.double(), gaussians.means.double() @ mirror)
    expected = mirror @ covariances(gaussians) @ mirror
    torch.testing.assert_close(covariances(flipped), expected)
    directions = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=1)
    seen, mirrored = (
        (sh_basis(d, degree)[:, :, None] * g.sh.double()).sum(1)
        for g, d in ((gaussians, directions), (flipped, directions @ mirror))
    )
    torch.testing.assert_close(seen, mirrored)


def test_flipping_twice_restores_every_bit() -> None:
    twice = collect(Flipped(Flipped(sample(), (1, -1, -1)), (1, -1, -1)))
    for name, values in sample().arrays().items():
        assert np.array_equal(twice.arrays()[name].view("u4"), values.view("u4"))
