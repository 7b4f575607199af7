"""``split.train_views``: the views that papers train on and measure, and nothing of the others."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.io.fact_cache import FactCache
from pipeline.io.folders import PhotoFolder
from pipeline.io.posefiles import GivenPoses
from pipeline.plan.chosen_views import ChosenViews, choose_views
from pipeline.plan.protocols import PUBLISHED_SCENES
from pipeline.plan.scene_folder import SceneFolder
from pipeline.runtime.errors import UserError
from pipeline.scene.views import evenly_spaced
from tests.pictures import photos, picture
from tests.plan.test_published import planned
from tests.plan.test_scan import config, given_model, look, write_sparse
from tests.tools import need_data

DTU_TESTED = [1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, 29, 30, 31, 32, 33, 34, 35]
DTU_TESTED += [41, 42, 43, 45, 46, 47]
BONSAI_24 = [1, 13, 26, 38, 51, 63, 76, 89, 101, 114, 126, 139]
BONSAI_24 += [153, 165, 178, 190, 203, 215, 228, 241, 253, 266, 278, 291]


def poses_of(count: int, splits: dict[str, Any] | None = None) -> GivenPoses:
    """Poses in the order of the photographs."""
    return GivenPoses(
        kind="llff",
        path="poses_bounds.npy",
        num_images=count,
        models=("SIMPLE_PINHOLE",),
        pinhole=True,
        num_points=0,
        tracked=0,
        centred=True,
        names=(),
        splits=splits or {},
    )


def chosen(folder: str, names: list[str], poses: GivenPoses, **split: Any) -> ChosenViews:
    at = SceneFolder(Path(folder), config(split=split), FactCache(None))
    found = choose_views(at, poses, PhotoFolder("images", "images", "", names), names)
    at.faults.check([])
    return found


def parts(found: ChosenViews) -> tuple[list[str], list[str]]:
    training = [name for name, part in found.split.items() if part == "train"]
    return training, [name for name, part in found.split.items() if part == "test"]


@pytest.mark.parametrize(
    ("folder", "count", "train_views", "training", "tested"),
    [
        ("llff_fern", 20, 3, [1, 10, 19], [0, 8, 16]),
        ("fern", 20, 6, [1, 4, 7, 12, 15, 19], [0, 8, 16]),
        ("nerf_llff_data_fern", 20, 9, [1, 3, 5, 7, 10, 12, 14, 17, 19], [0, 8, 16]),
        ("room", 41, 3, [1, 20, 39], list(range(0, 41, 8))),
        (
            *("mip360_bonsai", 292, 12),
            [1, 27, 53, 79, 106, 132, 159, 186, 212, 238, 265, 291],
            list(range(0, 292, 8)),
        ),
        ("bonsai", 292, 24, BONSAI_24, list(range(0, 292, 8))),
        ("dtu_scan8", 49, 3, [22, 25, 28], DTU_TESTED),
        ("scan40", 49, 6, [22, 25, 28, 40, 44, 48], DTU_TESTED),
        ("scan114", 64, 9, [0, 8, 13, 22, 25, 28, 40, 44, 48], DTU_TESTED),
    ],
)
def test_the_views_of_papers(
    folder: str, count: int, train_views: int, training: list[int], tested: list[int]
) -> None:
    names = [f"{i:03d}.png" for i in range(count)]
    # test_every is that of papers, whatever is configured.
    options = {"source": "published", "train_views": train_views, "test_every": 5}
    found = chosen(folder, names, poses_of(count), **options)
    assert found.published is not None and found.published.train_views == train_views
    assert parts(found) == ([names[i] for i in training], [names[i] for i in tested])


def test_the_views_of_papers_for_nerf_synthetic() -> None:
    counts = {"train": 100, "test": 200}
    listed = {f"{part}/r_{i}.png": part for part, n in counts.items() for i in range(n)}
    options = {"source": "published", "train_views": 8}
    found = chosen("nerf_lego", sorted(listed), poses_of(300, listed), **options)
    training, tested = parts(found)
    assert set(training) == {f"train/r_{i}.png" for i in (2, 16, 26, 55, 73, 76, 86, 93)}
    assert set(tested) == {f"test/r_{i}.png" for i in range(0, 200, 8)} and len(tested) == 25


def test_scenes_of_the_same_name_differ_by_their_photographs() -> None:
    """Room is a scene of LLFF and of Mip-NeRF 360."""
    rooms = {s.title: s for s in PUBLISHED_SCENES.values() if s.scene == "room"}
    sizes = {title: (*scene.photographs, scene.image_folder) for title, scene in rooms.items()}
    assert sizes == {
        "room of Mip-NeRF 360": (311, "images_2"),
        **{f"room of Mip-NeRF 360 with {n} training views": (311, "images_8") for n in (12, 24)},
        **{f"room of LLFF with {n} training views": (41, "images_8") for n in (3, 6, 9)},
    }


def test_few_views_of_ones_own_scene_and_split() -> None:
    names = [f"{i}.png" for i in range(10)]
    assert parts(chosen("mine", names, poses_of(10), train_views=2, test_every=5)) == (
        ["1.png", "9.png"],
        ["0.png", "5.png"],
    )
    assert parts(chosen("mine", names, poses_of(10), train_views=3, test_every=0)) == (
        ["0.png", "4.png", "9.png"],
        [],
    )
    own = {name: "test" if name > "6.png" else "train" for name in names}
    assert parts(chosen("mine", names, poses_of(10, own), train_views=2)) == (
        ["0.png", "6.png"],
        ["7.png", "8.png", "9.png"],
    )


@given(count=st.integers(1, 400), number=st.integers(2, 400))
def test_evenly_spaced_items(count: int, number: int) -> None:
    found = evenly_spaced(range(count), number)
    steps = np.diff(found)
    assert len(found) == min(count, number) and (found[0], found[-1]) == (0, count - 1)
    assert not len(steps) or (steps.min() >= 1 and steps.max() - steps.min() <= 1)


def test_photographs_that_are_left_out_are_read_by_no_stage(tmp_path: Path) -> None:
    """Neither they nor the points that they observed; their masks are no unused files."""
    scene = tmp_path / "mine"
    names = [path.name for path in photos(scene / "images", 11, (96, 64))]
    for name in names:
        picture(scene / "masks" / name, (96, 64), mode="L")
    write_sparse(scene / "sparse" / "0", [*names[:9], names[10]], (96, 64))
    options = {"split": {"train_views": 2}}
    found, plan = look(scene, config(**options)), planned(scene, **options)
    # The tenth photograph has no pose, so that the last of the others is the eleventh.
    assert [photo.name for photo in found.photos] == [names[i] for i in (0, 1, 8, 10)]
    assert found.unused == () and len(given_model(found).without_points().model.points) == 0
    assert plan.facts.given_poses is not None and plan.facts.given_poses.num_points == 0
    assert plan.stages["evaluate"].reason == "2 test views"
    assert found.few_views in plan.stages["inspect"].decisions
    assert found.few_views.startswith("2 training views, evenly spaced among 8, and 2 test views")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"poses": "ignore", "split": {"train_views": 3}}, "given poses, found none"),
        ({"split": {"train_views": 12}}, "at most 9, .*, found 12"),
        ({"split": {"train_views": 5, "source": "published"}}, "papers use 3, 6 or 9 .*, found 5"),
        ({"split": {"source": "published"}}, "papers use 3, 6 or 9 .*, found all"),
    ],
)
def test_what_cannot_be_done_is_one_message(
    options: dict[str, Any], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    title = "fern of LLFF with {} training views"
    for number in (3, 6, 9):
        scene = PUBLISHED_SCENES[title.format(number)]
        small = scene.__class__(**(vars(scene) | {"photographs": (11,)}))
        monkeypatch.setitem(PUBLISHED_SCENES, scene.title, small)
    names = [path.name for path in photos(tmp_path / "fern" / "images", 11)]
    write_sparse(tmp_path / "fern" / "sparse" / "0", names, (64, 48))
    with pytest.raises(UserError) as error:
        planned(tmp_path / "fern", **options)
    assert re.search(words, str(error.value)) and "split" in error.value.fix


def test_fern_is_measured_as_published() -> None:
    fern = need_data("llff_fern")
    plan = planned(fern, preset="fast", split={"source": "published", "train_views": 3})
    assert plan.facts.published_scene == "fern of LLFF with 3 training views"
    assert plan.stages["evaluate"].decisions[0].endswith("measured as published, as configured")
    assert plan.facts.view_size == (504, 378) and plan.config.poses == "keep"
    assert "papers use 3, 6 or 9" in planned(fern).stages["evaluate"].decisions[0]
