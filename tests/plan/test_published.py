"""Scenes of published benchmarks: recognised by their layout, measured as papers do on request, and
never called so otherwise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.config.schema import Evaluate, Train
from pipeline.metrics.evaluate import evaluate_views
from pipeline.metrics.evaluation import PublishedProtocol
from pipeline.metrics.protocol import choose_protocol
from pipeline.metrics.published import against_published
from pipeline.plan.protocols import PUBLISHED_SCENES, recognise
from pipeline.plan.published import planned_deviations
from pipeline.plan.values import Plan
from pipeline.runtime.errors import UserError
from pipeline.scene.exposure import NO_GAINS, ExposureGains, ViewLight
from pipeline.scene.views import load_views
from tests.io.test_transforms import frame, write
from tests.metrics.test_evaluate import nothing
from tests.pictures import photos, picture
from tests.plan.test_listed_split import posed
from tests.plan.test_scan import config, given_model, look, write_sparse
from tests.plans import make_plan

PUBLISHED = {"split": {"source": "published"}}
# Eleven photographs, so that 0 and 8 are test views.
SMALL = {
    "bonsai of Mip-NeRF 360": {"photographs": (11,), "size": (48, 32)},
    "truck of Tanks and Temples": {"photographs": (11,)},
    "lego of NeRF-synthetic": {"size": (16, 16), "num_test": 3},
    "scan24 of DTU": {"photographs": (11,), "size": (32, 24)},
    "fern of LLFF with 3 training views": {"photographs": (11,), "size": (24, 16), "num_test": 2},
    "lego of NeRF-synthetic with 8 training views": {"size": (12, 12), "num_test": 1},
    "scan8 of DTU with 3 training views": {"size": (16, 12)},
}


@pytest.fixture(autouse=True)
def small_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Published scenes of few and small photographs."""
    for name, changes in SMALL.items():
        small = replace(PUBLISHED_SCENES[name], **changes)
        monkeypatch.setitem(PUBLISHED_SCENES, name, small)


def mip_nerf_360(folder: Path) -> Path:
    scene = folder / "360_v2-bonsai"
    photos(scene / "images", 11, (96, 64))
    photos(scene / "images_2", 11, (48, 32))
    photos(scene / "images_4", 11, (24, 16))
    write_sparse(scene / "sparse" / "0", [f"p{i:02d}.jpg" for i in range(11)], (96, 64))
    return scene


def tanks_and_temples(folder: Path) -> Path:
    """As released: the cameras are of about twice the photographs' size."""
    scene = folder / "truck"
    photos(scene / "images", 11, (979, 546))
    write_sparse(scene / "sparse" / "0", [f"p{i:02d}.jpg" for i in range(11)], (1957, 1091))
    return scene


def nerf_synthetic(folder: Path) -> Path:
    scene = folder / "nerf_lego_800"
    for split, count in (("train", 100), ("test", 3), ("val", 1)):
        for i in range(count):
            picture(scene / split / f"r_{i}.png", (16, 16), mode="RGBA")
        frames = [posed(f"./{split}/r_{i}", i) for i in range(count)]
        write(scene, {"camera_angle_x": 0.7, "frames": frames}, f"transforms_{split}.json")
    return scene


def llff(folder: Path) -> Path:
    """Without the points of all photographs, which a COLMAP model has beside the poses."""
    scene = folder / "nerf_llff_data-fern"
    for suffix, size in (("", (192, 128)), ("_4", (48, 32)), ("_8", (24, 16))):
        photos(scene / f"images{suffix}", 11, size)
    write_sparse(scene / "sparse" / "0", [f"p{i:02d}.jpg" for i in range(11)], (192, 128))
    return scene


def dtu_few(folder: Path) -> Path:
    return dtu(folder, "scan8", 49)


def dtu(folder: Path, name: str = "scan24", count: int = 11) -> Path:
    scene = folder / name
    names = [f"{i:04d}.png" for i in range(count)]
    for name in names:
        picture(scene / "images" / name, (64, 48), mode="RGBA")
    write_sparse(scene / "sparse" / "0", names, (64, 48))
    return scene


LAYOUTS = {
    "Mip-NeRF 360": mip_nerf_360,
    "Tanks and Temples": tanks_and_temples,
    "NeRF-synthetic": nerf_synthetic,
    "DTU": dtu,
}


def planned(folder: Path, **sections: Any) -> Plan:
    return make_plan(look(folder, config(**sections)), config(**sections))


def measured(
    folder: Path, *, gains: ExposureGains = NO_GAINS, **sections: Any
) -> PublishedProtocol:
    """The protocol of a model without Gaussians, through the plan and the evaluation."""
    plan = planned(folder, **sections)
    settled = plan.config
    found = look(folder, settled)
    assert found.fingerprint == plan.facts.fingerprint, "inspect would find another scene"
    views = load_views(found.manifest, given_model(found).model, settled.views, settled.split)
    protocol = choose_protocol(views, settled.split, settled.train)
    evaluation = evaluate_views(
        nothing(), protocol, Evaluate(), settled.train, folder / "renders", gains=gains, threads=1
    )
    assert plan.facts.published_scene is not None
    deviations = planned_deviations(plan)
    return against_published(plan.facts.published_scene, deviations, protocol, evaluation)


@pytest.mark.parametrize("benchmark", LAYOUTS)
def test_a_scene_is_measured_as_published_on_request(benchmark: str, tmp_path: Path) -> None:
    found = measured(LAYOUTS[benchmark](tmp_path), **PUBLISHED, preset="fast")
    assert (found.benchmark, found.deviations) == (benchmark, ())
    assert found.text.endswith("measured as published")


@pytest.mark.parametrize(
    ("layout", "train_views", "deviations"),
    [
        (llff, 3, ()),
        (nerf_synthetic, 8, ()),
        (dtu_few, 3, ("whole images are measured, not the object inside of its mask",)),
    ],
)
def test_few_views_are_measured_as_published_on_request(
    layout: Any, train_views: int, deviations: tuple[str, ...], tmp_path: Path
) -> None:
    split = {"source": "published", "train_views": train_views}
    found = measured(layout(tmp_path), split=split, preset="fast")
    assert (found.train_views, found.deviations) == (train_views, deviations)
    assert f"with {train_views} training views, " in found.text


@pytest.mark.parametrize("benchmark", LAYOUTS)
def test_given_poses_and_photographs_stay_as_they_are(benchmark: str, tmp_path: Path) -> None:
    plan = planned(LAYOUTS[benchmark](tmp_path), **PUBLISHED)
    assert plan.config.poses == "keep" and plan.config.train.appearance == "none"
    assert not any(plan.runs(stage) for stage in ("sfm", "refine", "undistort"))
    assert "measured as published" in plan.stages["evaluate"].decisions[0]


@pytest.mark.parametrize(
    ("layout", "sections", "words"),
    [
        (mip_nerf_360, {"views": {"max_long_side_px": 30}}, "views of 30x20 pixels, not 48x32"),
        (mip_nerf_360, {"split": {"test_every": 5}}, "not every 8th view"),
        (mip_nerf_360, {"inspect": {"image_folder": "images"}}, "of images/, not of images_2/"),
        (nerf_synthetic, {"train": {"background": "black"}}, "the background is not white"),
        (nerf_synthetic, {"split": {"source": "every"}}, "not those that the data set lists"),
        (dtu, {"split": {"test_every": 8}}, "there are test views"),
        (dtu, {"train": {"background": "white"}}, "the background is not black"),
        (llff, {"split": {"train_views": 3, "test_every": 5}}, "test views are not every 8th view"),
        (llff, {"split": {"train_views": 3, "test_every": 5}}, "3 test views, not 2"),
        (nerf_synthetic, {"split": {"train_views": 8}}, "not those that papers list"),
        (mip_nerf_360, {"split": {"train_views": 5}}, "only 5 training views"),
    ],
)
def test_what_differs_from_the_published_protocol_is_named(
    layout: Any, sections: dict[str, Any], words: str, tmp_path: Path
) -> None:
    found = measured(layout(tmp_path), **sections)
    assert any(words in text for text in found.deviations), found.deviations
    assert "NOT as published" in found.text


def test_published_options_take_precedence_over_size_test_views_and_masks(tmp_path: Path) -> None:
    scene = tanks_and_temples(tmp_path)
    photos(scene / "masks", 11, (979, 546), mode="L")
    changed = {"split": {"source": "published", "test_every": 3}, "views": {"max_long_side_px": 90}}
    assert measured(scene, **changed).deviations == ()
    assert "masked pixels are excluded" in measured(scene).deviations


def test_a_resized_copy_is_not_the_published_scene(tmp_path: Path) -> None:
    """A Mip-NeRF 360 scene of which somebody passes on small images."""
    photos(tmp_path / "bonsai" / "images", 11, (40, 27))
    write_sparse(
        tmp_path / "bonsai" / "sparse" / "0", [f"p{i:02d}.jpg" for i in range(11)], (40, 27)
    )
    assert measured(tmp_path / "bonsai", **PUBLISHED).deviations == (
        "photographs of images/, not of images_2/",
        "views of 40x27 pixels, not 48x32",
    )


def test_a_part_of_the_listed_test_views_is_said(tmp_path: Path) -> None:
    scene = nerf_synthetic(tmp_path)
    (scene / "test" / "r_1.png").unlink()
    assert measured(scene, **PUBLISHED).deviations == ("2 test views, not 3",)


def test_exposure_gains_and_moved_test_cameras_are_said(tmp_path: Path) -> None:
    scene = tanks_and_temples(tmp_path)
    gains = ExposureGains({f"p{i:02d}.jpg": ViewLight(gain=(1.0, 1.0, 1.0)) for i in range(11)})
    assert "gains" in measured(scene, gains=gains).text
    assert "pose of each test camera" in measured(scene, train=Train(refine_poses=True)).text


def test_poses_of_ones_own_are_said(tmp_path: Path) -> None:
    plan = planned(mip_nerf_360(tmp_path), **PUBLISHED, poses="ignore")
    assert "poses are estimated, not those of the data set" in planned_deviations(plan)


def test_other_folders_are_of_no_benchmark(tmp_path: Path) -> None:
    """By a common name alone, with photographs missing, or with the training views alone."""
    photos(tmp_path / "truck" / "images", 10)
    assert planned(tmp_path / "truck").facts.published_scene is None
    photos(tmp_path / "my_truck" / "images", 11)
    assert planned(tmp_path / "my_truck").facts.published_scene is None
    for i in range(100):
        picture(tmp_path / "lego" / "train" / f"r_{i}.png", (16, 16))
    frames = [posed(f"./train/r_{i}", i) for i in range(100)]
    write(tmp_path / "lego", {"camera_angle_x": 0.7, "frames": frames}, "transforms_train.json")
    assert planned(tmp_path / "lego").facts.published_scene is None
    picture(tmp_path / "chair" / "images" / "a.png")
    write(tmp_path / "chair", {"fl_x": 9, "frames": [frame(path="images/a.png")]})
    single = config(inspect={"min_images": 1})
    assert make_plan(look(tmp_path / "chair", single), single).facts.published_scene is None


@pytest.mark.parametrize(
    ("name", "count", "words"),
    [
        ("room_at_home", 3, "expected a folder named as a scene"),
        ("truck", 10, "expected the 11 photographs of truck of Tanks and Temples, found 10"),
        ("lego", 3, "expected train/r_0 to r_99"),
    ],
)
def test_a_protocol_that_does_not_apply_is_one_message(
    name: str, count: int, words: str, tmp_path: Path
) -> None:
    photos(tmp_path / name / "images", count)
    with pytest.raises(UserError, match=words) as error:
        planned(tmp_path / name, **PUBLISHED)
    assert "split.source" in error.value.fix


def test_names_of_data_sets_are_no_part_of_a_scene() -> None:
    names = [f"p{i}" for i in range(11)]
    for folder in ("truck", "tandt_truck", "T2-Truck"):
        found = recognise(folder, names)
        assert found is not None and found.scene == "truck"
    assert recognise("dtu_scan24", names) is PUBLISHED_SCENES["scan24 of DTU"]
