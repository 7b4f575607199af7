"""The choice of a model for the appearance of photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.photos.disagreement import ColourDisagreement
from pipeline.photos.exposure import GAMMA
from pipeline.training.appearance import choose as choose_module
from pipeline.training.appearance.choose import AppearanceChoice, choose_appearance
from tests.photos.test_disagreement import photographs
from tests.photos.test_shading import lit, observations

ALIKE = np.ones((8, 3))
EXPOSED = np.array([[0.7] * 3, [1.4] * 3] * 4)


def choose(
    folder: Path,
    wanted: str,
    lights: list[int],
    gains: np.ndarray = ALIKE,
    *,
    has_alpha: bool = False,
    in_blocks: bool = False,
) -> AppearanceChoice:
    views, model, points = photographs(folder, lights, gains)
    return choose_appearance(
        views,
        model,
        points,
        wanted,
        cameras={view.name: "one" for view in views},
        has_alpha=has_alpha,
        in_blocks=in_blocks,
    )


def test_photographs_choose_by_what_the_photographs_show(tmp_path: Path) -> None:
    alike = choose(tmp_path, "measured", [0] * 8)
    assert not alike.gains and not alike.embeddings and not alike.decisions
    assert alike.counters["colour_disagreement"] < 0.03
    exposed = choose(tmp_path, "measured", [0] * 8, EXPOSED)
    assert exposed.gains and not exposed.embeddings
    assert "exposures differ" in exposed.decisions[0]
    lights = choose(tmp_path, "measured", [0, 1] * 4, EXPOSED)
    assert lights.embeddings and lights.gains
    assert "train.appearance" in lights.decisions[0]


@pytest.mark.parametrize(
    ("wanted", "gains", "embeddings"),
    [("none", False, False), ("exposure", True, False), ("embedding", True, True)],
)
def test_a_chosen_model_is_used(tmp_path: Path, wanted: str, gains: bool, embeddings: bool) -> None:
    found = choose(tmp_path, wanted, [0, 1] * 4)
    assert bool(found.gains) == gains and found.embeddings == embeddings
    assert not found.counters


def test_blocks_have_no_embeddings_and_alpha_no_gains(tmp_path: Path) -> None:
    in_blocks = choose(tmp_path, "measured", [0, 1] * 4, EXPOSED, in_blocks=True)
    assert in_blocks.gains and not in_blocks.embeddings
    with_alpha = choose(tmp_path, "measured", [0, 1] * 4, EXPOSED, has_alpha=True)
    assert not with_alpha.gains and not with_alpha.embeddings and not with_alpha.counters


@pytest.mark.parametrize(("disagreement", "embeddings"), [(0.11, False), (0.16, True)])
def test_embeddings_need_photographs_that_disagree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disagreement: float, embeddings: bool
) -> None:
    """Vignetting and inaccurate points make the photographs of one light disagree as well."""
    found = ColourDisagreement(disagreement, 1.0)
    monkeypatch.setattr(choose_module, "colour_disagreement", lambda *_: found)
    assert choose(tmp_path, "measured", [0] * 8).embeddings == embeddings


def test_vignetting_is_modelled_beside_embeddings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the vignetting of its camera for each view, and gains of the training views alone."""
    seen = observations(lit(gains=0.5))
    trained = len(seen.photo_of)
    views, model, points = photographs(tmp_path, [0, 1] * (trained // 2), np.ones((trained, 3)))
    cameras = {view.name: f"body {number % 2}" for number, view in enumerate(views)}
    test = replace(views[1], name="test.png", is_test=True)
    cameras[test.name] = "body 1"
    monkeypatch.setattr(choose_module, "observe", lambda *_: seen)
    all_views = [*views, test]
    found = choose_appearance(
        all_views, model, points, "embedding", cameras=cameras, has_alpha=False, in_blocks=False
    )
    assert found.gains.root.keys() == {view.name for view in views}
    for number, view in enumerate(all_views):
        light = found.shading.root[view.name]
        assert light.gain == (1.0, 1.0, 1.0)
        expected = -1 / GAMMA if view is test or number % 2 else 0.0
        assert sum(light.vignetting) == pytest.approx(expected, abs=0.03)
    assert "corners are darker" in "".join(found.decisions)


@pytest.mark.parametrize("cameras", [1, 8])
def test_a_collection_that_cannot_be_compared_has_embeddings(tmp_path: Path, cameras: int) -> None:
    """Photographs of another time have few matches. One camera's are not suspected."""
    scene = photographs(tmp_path, [0, 1] * 4, ALIKE, tracks="none", shift=0.05)
    groups = {view.name: f"{number % cameras}" for number, view in enumerate(scene[0])}
    found = choose_appearance(*scene, "measured", cameras=groups, has_alpha=False, in_blocks=False)
    assert found.embeddings == (cameras == 8)
    assert ("too few common points" in "".join(found.decisions)) == (cameras == 8)


def test_a_collection_in_blocks_is_told_why_there_are_no_embeddings(tmp_path: Path) -> None:
    scene = photographs(tmp_path, [0, 1] * 4, ALIKE)
    groups = {view.name: view.name for view in scene[0]}
    found = choose_appearance(*scene, "measured", cameras=groups, has_alpha=False, in_blocks=True)
    assert not found.embeddings and "partition.blocks: 1" in found.decisions[0]
