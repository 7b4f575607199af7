"""Appearance embeddings: values and gradients, against a float64 reference and differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.render import RasterOptions, make_backend, reference
from pipeline.splats.gaussians import Gaussians
from pipeline.training.appearance.embedding import (
    AppearanceEmbeddings,
    appearance_gradients,
    colour_offsets,
    with_appearance,
)
from tests.render.scenes import camera, random_scene, relative

CAMERA = camera(33, 24, rotated=True)
# Clamped colours have their true gradient, which finite differences have as well.
OPTIONS = RasterOptions(background=(0.2, 0.5, 0.9), clamp_color_gradient=True)
SIZE = 2


def shown(sh: torch.Tensor, appearance: torch.Tensor, embedding: torch.Tensor) -> torch.Tensor:
    """The reference: SH coefficients of Gaussians in a photograph."""
    change = torch.einsum("nkc,k->nc", appearance, embedding)
    return torch.cat([sh[:, :1] + change[:, None], sh[:, 1:]], 1)


@pytest.fixture
def gaussians() -> Gaussians:
    found = Gaussians(*random_scene(3, 80, size=0.2))
    found.appearance = torch.randn(80, SIZE, 3, generator=torch.manual_seed(1)) * 0.3
    return found


EMBEDDING = np.array([0.7, -1.3])


def test_colours_equal_the_reference(gaussians: Gaussians) -> None:
    assert gaussians.appearance is not None
    expected = shown(
        gaussians.sh.double(), gaussians.appearance.double(), torch.from_numpy(EMBEDDING)
    )
    found = with_appearance(gaussians, EMBEDDING)
    assert torch.allclose(found.sh.double(), expected, atol=1e-6)
    offsets = colour_offsets(gaussians.appearance, EMBEDDING)
    assert torch.allclose(offsets.double(), expected[:, 0] - gaussians.sh[:, 0], atol=1e-6)


def test_a_gain_multiplies_the_render(gaussians: Gaussians) -> None:
    """Also where colours are clamped; the background stays as it is."""
    backend, gain = make_backend(), np.array([0.5, 1.0, 1.7])
    black = RasterOptions(background=(0.0, 0.0, 0.0))
    plain, shown = (
        backend.forward(*with_appearance(gaussians, EMBEDDING, g).parameters(), CAMERA, black).color
        for g in (None, gain)
    )
    assert torch.allclose(shown, plain * torch.from_numpy(gain).float(), atol=1e-5)


def test_gradients_equal_the_reference_and_finite_differences(gaussians: Gaussians) -> None:
    assert gaussians.appearance is not None
    backend = make_backend()
    weights = torch.randn(24, 33, 3, generator=torch.manual_seed(2))
    rendered = backend.forward(*with_appearance(gaussians, EMBEDDING).parameters(), CAMERA, OPTIONS)
    gradients = backend.backward(rendered, weights, colors=True)
    assert gradients.colors is not None
    d_embedding, d_appearance = appearance_gradients(
        gaussians.appearance, EMBEDDING, gradients.colors
    )

    fixed = [tensor.double() for tensor in gaussians.parameters()]
    appearance = gaussians.appearance.double().requires_grad_()
    embedding = torch.from_numpy(EMBEDDING).clone().requires_grad_()

    def value(embedding: torch.Tensor) -> torch.Tensor:
        sh = shown(fixed[4], appearance, embedding)
        return (reference.render(*fixed[:4], sh, CAMERA, OPTIONS)[1].color * weights).sum()

    expected = torch.autograd.grad(value(embedding), [embedding, appearance])
    assert relative(torch.from_numpy(d_embedding), expected[0]) < 1e-4
    assert relative(d_appearance, expected[1]) < 1e-4
    with torch.no_grad():
        for number in range(SIZE):
            step = 1e-4 * torch.eye(SIZE, dtype=torch.float64)[number]
            slope = (value(embedding + step) - value(embedding - step)) / 2e-4
            assert float(slope) == pytest.approx(d_embedding[number], rel=1e-3, abs=1e-3)


def test_what_is_shown_is_undone_to_the_bit(gaussians: Gaussians) -> None:
    embeddings = AppearanceEmbeddings(np.stack([EMBEDDING, -EMBEDDING]))
    before = gaussians.sh.clone()
    colours = embeddings.show(gaussians, 1)
    assert not torch.equal(gaussians.sh[:, 0], before[:, 0])
    assert torch.equal(gaussians.sh[:, 1:], before[:, 1:])
    gaussians.sh[:5, 0] += 0.25
    embeddings.hide(gaussians, colours)
    assert torch.equal(gaussians.sh[5:], before[5:])
    assert torch.allclose(gaussians.sh[:5, 0], before[:5, 0] + 0.25, atol=1e-6)


def test_the_scene_has_the_colours_of_the_mean_photograph(gaussians: Gaussians) -> None:
    embeddings = AppearanceEmbeddings(np.array([[1.0, 0.5], [2.0, -3.0], [0.5, 0.1]]))
    centred, appearance = embeddings.centred(gaussians, ["a", "b", "c"], None)
    assert centred.appearance is None
    mean = np.mean(list(appearance.embeddings.values()), 0)
    assert np.abs(mean).max() < 1e-12
    for index, name in enumerate("abc"):
        before = with_appearance(gaussians, embeddings.embeddings[index])
        centred.appearance = torch.from_numpy(appearance.colors)
        after = with_appearance(centred, appearance.embeddings[name])
        assert torch.allclose(before.sh, after.sh, atol=1e-5)


def test_the_first_step_is_the_learning_rate(gaussians: Gaussians) -> None:
    """Up or down, of the view's embedding only, and of the Gaussians that it shows."""
    from pipeline.render import AdamRates, Moments
    from pipeline.training.appearance.embedding import MAX_CHANGE

    assert gaussians.appearance is not None
    embeddings = AppearanceEmbeddings(np.stack([EMBEDDING, EMBEDDING]))
    before = gaussians.appearance.clone()
    d_colors = torch.zeros(80, 3)
    d_colors[:40] = torch.randn(40, 3, generator=torch.manual_seed(3))
    moments = Moments(torch.zeros_like(before), torch.zeros_like(before))
    adam = moments, AdamRates(0.01, 1)
    embeddings.step(0, gaussians, d_colors, *adam, 0.05, make_backend(), 1)
    assert np.allclose(np.abs(embeddings.embeddings[0] - EMBEDDING), 0.05 * MAX_CHANGE)
    assert np.array_equal(embeddings.embeddings[1], EMBEDDING)
    change = (gaussians.appearance - before).abs()
    assert torch.allclose(change[:40], torch.full_like(change[:40], 0.01), rtol=1e-3)
    assert not change[40:].any()
