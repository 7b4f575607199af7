"""``Backend.update``: gradients and Adam at once."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pipeline.render import GaussianAdam, ImageGradients, Moments, RasterOptions
from pipeline.render.backend import Backend
from tests.render.scenes import camera, random_scene
from tests.render.updates import made_adam, moments_of


def updated(
    backend: Backend, count: int, degree: int, *, at_once: bool, statistics: bool = True
) -> list[Tensor]:
    """Everything that a step changes or returns, of ``count`` Gaussians."""
    scene = random_scene(5, count, degree=degree)
    scene[0][::3, 2] *= -1  # behind the camera
    cam, draws = camera(70, 50), torch.Generator().manual_seed(2)
    d_color = torch.randn(50, 70, 3, generator=draws)
    d_color[:, :20] = 0.0  # no gradient there
    d_alpha = torch.randn(50, 70, generator=draws)
    fwd = backend.forward(*scene, cam, RasterOptions(sh_degree=degree))
    adam, observed = made_adam(scene), torch.rand(2, count, generator=draws)
    update = backend.update if at_once else lambda *a, **k: Backend.update(backend, *a, **k)
    found = update(
        fwd, scene, ImageGradients(d_color, d_alpha), adam=adam, colors=True, camera=True,
        statistics=tuple(observed) if statistics else None,
    )  # fmt: skip
    assert found.colors is not None and found.camera is not None
    others = (observed, adam.sh.last, found.colors, *vars(found.camera).values())
    return [*scene, *moments_of(adam), *others]


@pytest.mark.parametrize("count", [1, 16, 333, 1000])
@pytest.mark.parametrize("degree", [0, 3])
def test_at_once_has_the_bits_of_one_operator_after_another(
    backend: Backend, count: int, degree: int
) -> None:
    both = [updated(backend, count, degree, at_once=once) for once in (True, False)]
    differ = [k for k, pair in enumerate(zip(*both, strict=True)) if not torch.equal(*pair)]
    assert not differ


def test_statistics_may_be_left_out(backend: Backend) -> None:
    with_them, without = (
        updated(backend, 333, 3, at_once=True, statistics=given) for given in (True, False)
    )
    same = [torch.equal(*pair) for pair in zip(with_them, without, strict=True)]
    assert same.count(False) == 1  # the statistics


def wrong(adam: GaussianAdam) -> dict[str, GaussianAdam]:
    """Invalid arguments, by what is wrong."""
    few = Moments(*(moment[:-1] for moment in vars(adam.log_scales).values()))
    shared = replace(adam.log_scales, exp_avg_sq=adam.log_scales.exp_avg_sq[:, :1].contiguous())
    two = adam.frame_rates
    return {
        "shapes differ": replace(adam, log_scales=few),
        "of their own": replace(adam, log_scales=shared),
        "one rate": replace(adam, opacity_rates=two),
        "step": replace(adam, frame_rates=replace(two, step=0)),
        "float32": replace(adam, opacity_logits=Moments(*torch.zeros(2, 9, dtype=torch.float64))),
        "last": replace(adam, sh=replace(adam.sh, last=adam.sh.last[:-1])),
    }


def test_invalid_arguments_are_errors(backend: Backend) -> None:
    scene, cam = random_scene(5, 9), camera(70, 50)
    fwd = backend.forward(*scene, cam, RasterOptions())
    d_color = ImageGradients(torch.zeros(50, 70, 3))
    for message, adam in wrong(made_adam(scene)).items():
        with pytest.raises(ValueError, match=message):
            backend.update(fwd, scene, d_color, adam=adam)
    adam = made_adam(scene)
    other = random_scene(5, 10)
    with pytest.raises(ValueError, match="parameters"):
        backend.update(fwd, other, d_color, adam=made_adam(other))
    means = scene[0].t().contiguous().t()
    with pytest.raises(ValueError, match="contiguous"):
        backend.update(fwd, (means, *scene[1:]), d_color, adam=adam)
    with pytest.raises(ValueError, match="statistics"):
        seen = torch.zeros(8)
        backend.update(fwd, scene, d_color, adam=adam, statistics=(seen, seen))
    every_second = torch.zeros(18)[::2]
    with pytest.raises(ValueError, match="contiguous"):
        backend.update(fwd, scene, d_color, adam=adam, statistics=(every_second, every_second))
