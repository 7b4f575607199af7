"""Losses on alpha."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from pipeline.training.data.targets import Targets
from pipeline.training.losses.alpha import AlphaLoss, mask_gradient
from tests.training.data.test_targets import view_of


def test_the_mask_loss_is_relative_to_the_pixels_that_are_not_ignored(tmp_path: Path) -> None:
    mask = np.full((8, 8), 255, np.uint8)
    mask[0, 0] = mask[6:, 4:] = 0
    picture = np.full((8, 8, 3), 90, np.uint8)
    target = Targets([view_of(tmp_path / "a.png", picture, mask)], threads=1).get(0, 1)
    masked = mask_gradient(target, 0.5)
    assert masked is not None and mask_gradient(target, 0.0) is None
    np.testing.assert_allclose(masked, (mask == 0) * 0.5 / (mask > 0).sum(), rtol=1e-6)
    # What is in the ignored pixels of an overview is not empty: the block would fade.
    assert mask_gradient(replace(target, is_overview=True), 0.5) is None
    # Nor is what someone who passes by hides: holes would be trained there.
    assert target.ignored is not None
    person = torch.zeros_like(target.ignored)
    person[2:5, 1:3] = True
    passed = replace(target, ignored=target.ignored | person, transient=person)
    hidden = mask_gradient(passed, 0.5)
    assert hidden is not None
    np.testing.assert_array_equal(hidden > 0, mask == 0)


def test_alpha_gradient_is_the_gradient_of_its_losses(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (7, 9, 4), np.uint8)
    mask = np.where(rng.random((7, 9)) < 0.2, 0, 255).astype(np.uint8)
    target = Targets([view_of(tmp_path / "a.png", picture, mask)], threads=1).get(0, 1)
    alpha = torch.from_numpy(rng.random((7, 9), np.float32)).requires_grad_()
    counts = torch.from_numpy(mask > 0)
    error = alpha - torch.from_numpy(picture[..., 3] / np.float32(255))
    wanted = 0.4 * (error.abs() + 2.5 * error.square())[counts].mean()
    (wanted + 0.3 * alpha[~counts].sum() / counts.sum()).backward()
    view = SimpleNamespace(target=target)
    rendered = SimpleNamespace(alpha=alpha.detach())
    gradient = AlphaLoss(0.3, 0.4, 2.5).gradients(rendered, view).alpha
    assert gradient is not None and alpha.grad is not None
    torch.testing.assert_close(gradient, alpha.grad)
    assert not AlphaLoss(0.0, 0.0, 2.5).is_due(view, 1)
