"""Evaluation: the views measured, the background, and masked pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.config.schema import Evaluate, Split, Train
from pipeline.metrics.evaluate import VIGNETTING_PROTOCOL, diagnose, evaluate_views
from pipeline.metrics.protocol import NUM_TRAINING_VIEWS, choose_protocol
from pipeline.photos.load import ViewPixels
from pipeline.runtime.errors import UserError
from pipeline.scene.appearance import Appearance
from pipeline.scene.exposure import ExposureGains, ViewLight
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import SH_C0

SIZE = 32


def view(folder, name, picture, mask=None, is_test=True, x=0.0):
    Image.fromarray(picture).save(folder / f"{name}.png")
    if mask is not None:
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / f"{name}.mask.png")
    pose = np.eye(4)
    pose[0, 3] = x
    return View(
        name=name,
        image=str(folder / f"{name}.png"),
        mask=None if mask is None else str(folder / f"{name}.mask.png"),
        width=SIZE,
        height=SIZE,
        fx=SIZE,
        fy=SIZE,
        cx=SIZE / 2,
        cy=SIZE / 2,
        world_to_camera=pose,
        is_test=is_test,
    )


def nothing():
    """Gaussians outside all views: renders show the background only."""
    return Gaussians.from_arrays(
        {
            "means": np.array([[0, 0, -5.0]]),
            "log_scales": np.zeros((1, 3)),
            "quats": np.array([[1.0, 0, 0, 0]]),
            "opacity_logits": np.zeros(1),
            "sh": np.zeros((1, 1, 3)),
        }
    )


def measure(views, out, split=None, **train):
    config = Train(background=train.pop("background", "black"), **train)
    protocol = choose_protocol(views, split or Split(), config)
    return evaluate_views(nothing(), protocol, Evaluate(), config, out, threads=1)


def black():
    return np.zeros((SIZE, SIZE, 3), np.uint8)


def test_only_test_views_are_measured(tmp_path):
    junk = np.full_like(black(), 255)
    views = [view(tmp_path, "a", black()), view(tmp_path, "b", junk, is_test=False, x=1.0)]
    found = measure(views, tmp_path / "out")
    assert [v.name for v in found.per_view] == ["a"]
    assert found.psnr == 100
    assert "test views: one view in 8" in found.protocol.split


def test_a_sample_of_training_views_is_measured_as_well(tmp_path):
    junk = np.full_like(black(), 255)
    views = [view(tmp_path, "a", black())]
    views += [view(tmp_path, f"b{i}", junk, is_test=False, x=1.0 + i) for i in range(20)]
    protocol = choose_protocol(views, Split(), Train())
    assert len(protocol.training_views) == NUM_TRAINING_VIEWS
    assert {"b0", "b19"} <= {v.name for v in protocol.training_views}
    found = measure(views, tmp_path / "out")
    assert found.train_psnr == 0
    assert any("training photographs badly (0.0 dB)" in text for text in found.warnings)


@pytest.mark.parametrize(
    ("test_psnr", "train_psnr", "word"),
    [(15, 16, "badly"), (19, 28, "few"), (27, 30, None), (31, 30, None), (32, 39, None)],
)
def test_bad_scenes_are_diagnosed(test_psnr, train_psnr, word):
    found = diagnose(test_psnr, train_psnr)
    assert [word in text for text in found] == ([] if word is None else [True])


def test_gains_multiply_the_renders(tmp_path):
    grey = np.full_like(black(), 100)
    views = [view(tmp_path, "a", grey), view(tmp_path, "b", grey // 2, x=1.0)]
    config = Train(background="white")
    found = evaluate_views(
        nothing(),
        choose_protocol(views, Split(), config),
        Evaluate(),
        config,
        tmp_path / "out",
        gains=ExposureGains(
            {"a": ViewLight(gain=(100 / 255,) * 3), "b": ViewLight(gain=(50 / 255,) * 3)}
        ),
        threads=1,
    )
    assert found.psnr == 100
    assert found.psnr_without_gains < 5
    assert "gains" in found.protocol.exposure


def lit(gaussians, colour):
    """A wall in front of the camera, of this display value."""
    wall = Gaussians.from_arrays(gaussians.arrays())
    wall.means[:] = torch.tensor([0.0, 0.0, 3.0])
    wall.log_scales[:] = torch.tensor([3.0, 3.0, -3.0])
    wall.quats[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    wall.opacity_logits[:] = 12.0
    wall.sh[:] = (colour - 0.5) / SH_C0
    return wall


def test_appearance_is_fitted_on_the_left_half_and_measured_on_the_right(tmp_path):
    """The light of test photographs is that of no training photograph, and only their left halves
    tell it."""
    appearance = Appearance(
        np.full((1, 1, 3), 0.2 / SH_C0, np.float32), {"b": np.array([1.0]), "c": np.array([-1.0])}
    )
    photo = np.full_like(black(), 150)
    views = [view(tmp_path, "a", photo)]
    views += [
        view(tmp_path, n, np.full_like(black(), v), is_test=False)
        for n, v in (("b", 178), ("c", 76))
    ]
    config = Train(background="black")

    def measured(views):
        return evaluate_views(
            lit(nothing(), 0.5), choose_protocol(views, Split(), config), Evaluate(), config,
            tmp_path / "out", appearance=appearance, threads=1,
        )  # fmt: skip

    found = measured(views)
    assert found.psnr > 40
    assert found.train_psnr > 35, "training views have their own embeddings"
    assert found.psnr_without_fit == pytest.approx(-20 * np.log10((150 - 127.5) / 255), abs=0.3)
    assert "left half" in found.protocol.appearance
    # The right half changes nothing but the measure; a change of the left half changes the fit.
    other = photo.copy()
    other[:, SIZE // 2 :] = 100
    darker = measured([view(tmp_path, "a", other), *views[1:]])
    assert darker.psnr == pytest.approx(-20 * np.log10(50 / 255), abs=0.3)
    # Photographs that the scene was trained on are measured as a whole.
    alone = measured(views[1:])
    assert alone.psnr > 35
    assert alone.psnr_without_fit is None and alone.protocol.appearance is None


def test_appearance_is_fitted_through_the_vignetting_of_the_camera(tmp_path):
    appearance = Appearance(
        np.full((1, 1, 3), 0.2 / SH_C0, np.float32), {"b": np.array([1.0]), "c": np.array([-1.0])}
    )
    light = ViewLight(gain=(1.0, 1.0, 1.0), vignetting=(-1.0, 0.0))
    views = []
    for name, value in (("a", 150), ("b", 178), ("c", 76)):
        seen = view(tmp_path, name, np.full_like(black(), value), is_test=name == "a")
        shaded = np.rint(np.full_like(black(), value) * light.factor(seen)).astype(np.uint8)
        views.append(view(tmp_path, name, shaded, is_test=name == "a"))
    config = Train(background="black")
    found = evaluate_views(
        lit(nothing(), 0.5), choose_protocol(views, Split(), config), Evaluate(), config,
        tmp_path / "out", gains=ExposureGains(dict.fromkeys("abc", light)), appearance=appearance,
        threads=1,
    )  # fmt: skip
    assert found.psnr > 40 and found.train_psnr > 35
    assert found.protocol.exposure == VIGNETTING_PROTOCOL and found.psnr_without_gains is None


def test_a_mask_of_the_measured_half_hides_the_view(tmp_path):
    appearance = Appearance(np.zeros((1, 1, 3), np.float32), {"c": np.array([1.0])})
    mask = np.ones((SIZE, SIZE), bool)
    mask[:, SIZE // 2 :] = False
    views = [view(tmp_path, "a", black(), mask), view(tmp_path, "b", black())]
    config = Train(background="black")
    found = evaluate_views(
        nothing(), choose_protocol(views, Split(), config), Evaluate(), config, tmp_path / "out",
        appearance=appearance, threads=1,
    )  # fmt: skip
    assert [v.name for v in found.per_view] == ["b"]
    assert "a: its mask leaves no pixel" in found.warnings[0]


def test_the_protocol_reports_a_missing_test_split(tmp_path):
    found = measure([view(tmp_path, "a", black(), is_test=False)], tmp_path / "out")
    assert "TRAINING" in found.protocol.split


def test_the_protocol_says_what_few_training_views_leave_out(tmp_path):
    views = [view(tmp_path, "a", black()), view(tmp_path, "b", black(), is_test=False)]
    chosen = [replace(view, has_listed_split=True) for view in views]
    found = measure(chosen, tmp_path / "out", Split(train_views=2)).protocol
    assert found.split.startswith("1 training views (split.train_views) and 1 test views; other")
    assert "from the training photographs alone" in found.poses_and_points


def test_masked_pixels_are_excluded(tmp_path):
    picture, mask = black(), np.ones((SIZE, SIZE), bool)
    picture[:, :10], mask[:, :10] = 255, False
    found = measure([view(tmp_path, "a", picture, mask)], tmp_path / "out")
    assert found.psnr == 100
    assert found.ssim == pytest.approx(1)
    # The same picture without its mask is far off.
    assert measure([view(tmp_path, "b", picture)], tmp_path / "out").psnr < 10


def test_a_view_without_unmasked_pixels_is_skipped_with_a_warning(tmp_path):
    hidden = view(tmp_path, "a", black(), np.zeros((SIZE, SIZE), bool))
    found = measure([hidden, view(tmp_path, "b", black(), x=1.0)], tmp_path / "out")
    assert found.protocol.num_views == 1
    assert "a: its mask" in found.warnings[0]
    with pytest.raises(UserError, match="masks"):
        measure([hidden], tmp_path / "out")


@pytest.mark.parametrize(("trained", "expected"), [("black", 0.0), ("white", 1.0), ("random", 1.0)])
def test_background_is_that_of_training_and_white_for_random(tmp_path, trained, expected):
    views = [view(tmp_path, "a", black())]
    protocol = choose_protocol(views, Split(), Train(background=trained))
    assert protocol.background == (expected,) * 3
    picture = measure(views, tmp_path / "out", background=trained)
    assert (picture.psnr > 50) == (expected == 0)


def test_transparent_photographs_are_composited_over_the_background():
    rgb = np.full((1, 2, 3), 100, np.uint8)
    alpha = np.array([[0, 255]], np.uint8)
    over = ViewPixels(rgb, alpha, None).over((1.0, 1.0, 1.0))
    assert over[0, 0].tolist() == [255] * 3
    assert over[0, 1].tolist() == [100] * 3
