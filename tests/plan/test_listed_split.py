"""A scene's own split: which views are trained on, which are measured, and what the user reads."""

import numpy as np
import pytest

from pipeline.config.schema import Split, Train, Views
from pipeline.metrics.protocol import choose_protocol
from pipeline.plan.settle import settle
from pipeline.scene.manifest import Manifest
from pipeline.scene.views import View, load_views
from stages.evaluate import decide
from tests.io.test_transforms import frame, write
from tests.pictures import picture
from tests.plan.test_scan import config, given_model, look, names


def posed(path: str, index: int) -> dict:
    matrix = np.eye(4)
    matrix[0, 3] = index
    return frame(matrix, path=path)


def nerf_synthetic(folder, **counts: int) -> None:
    for split, count in counts.items():
        for i in range(count):
            picture(folder / split / f"r_{i}.png")
        frames = [posed(f"./{split}/r_{i}", i) for i in range(count)]
        write(folder, {"camera_angle_x": 0.7, "frames": frames}, f"transforms_{split}.json")


def views_of(folder, **sections) -> list[View]:
    options = config(**sections)
    found = look(folder, options)
    return load_views(found.manifest, given_model(found).model, Views(), options.split)


def test_the_split_of_nerf_synthetic_is_used_and_named(tmp_path):
    nerf_synthetic(tmp_path, train=9, test=3)
    views = views_of(tmp_path)
    assert [view.name for view in views if view.is_test] == [f"test/r_{i}.png" for i in range(3)]
    protocol = choose_protocol(views, Split(), Train())
    assert protocol.has_test_views and (protocol.num_training, len(protocol.views)) == (9, 3)


def test_validation_views_are_left_out_with_a_message(tmp_path):
    nerf_synthetic(tmp_path, train=3, test=2, val=2)
    found = look(tmp_path)
    assert not any(name.startswith("val/") for name in names(found))
    assert any("val/r_0.png" in line and "split.source" in line for line in found.warnings)


def test_validation_views_are_the_test_views_where_there_are_no_others(tmp_path):
    nerf_synthetic(tmp_path, train=3, val=2)
    tested = [view.name for view in views_of(tmp_path) if view.is_test]
    assert tested == ["val/r_0.png", "val/r_1.png"]


@pytest.mark.parametrize(("lists", "missing"), [({"train": 9}, "test"), ({"test": 9}, "training")])
def test_a_split_of_one_part_is_not_used_with_a_message(tmp_path, lists, missing):
    nerf_synthetic(tmp_path, **lists)
    assert sum(view.is_test for view in views_of(tmp_path)) == 2
    assert any(f"lists no {missing} view" in line for line in look(tmp_path).warnings)


def test_every_eighth_view_on_request(tmp_path):
    nerf_synthetic(tmp_path, train=6, test=3, val=1)
    views = views_of(tmp_path, split={"source": "every", "test_every": 5})
    assert [view.name for view in views if view.is_test] == ["test/r_0.png", "train/r_2.png"]
    assert len(views) == 10 and not choose_protocol(views, Split(), Train()).listed


def test_a_training_list_alone_is_no_split(tmp_path):
    nerf_synthetic(tmp_path, train=9)
    assert [view.is_test for view in views_of(tmp_path)] == [True, *[False] * 7, True]


def test_test_views_without_photographs_are_no_split(tmp_path):
    nerf_synthetic(tmp_path, train=9)
    write(tmp_path, {"camera_angle_x": 0.7, "frames": [posed("a", 0)]}, "transforms_test.json")
    assert sum(view.is_test for view in views_of(tmp_path)) == 2


def test_the_file_lists_of_nerfstudio_are_a_split(tmp_path):
    for i in range(4):
        picture(tmp_path / "images" / f"{i}.png")
    content = {
        "fl_x": 50,
        "frames": [posed(f"images/{i}.png", i) for i in range(4)],
        "train_filenames": ["images/0.png", "./images/2.png"],
        "test_filenames": ["images/1.png"],
        "val_filenames": ["images/1.png", 5],
    }
    write(tmp_path, content)
    assert [(v.name, v.is_test) for v in views_of(tmp_path)] == [
        ("0.png", False),
        ("1.png", True),
        ("2.png", False),
    ]


def test_the_plan_says_which_views_are_measured(tmp_path):
    nerf_synthetic(tmp_path, train=3, test=2)
    found = look(tmp_path)
    assert decide(found, settle(found, config())).reason.startswith("2 test views")


@pytest.mark.parametrize("test_photos", [(), ("p01.jpg",)])
def test_a_manifest_without_both_parts_has_no_split(test_photos):
    from tests.scene.test_views import make

    manifest, model = make(9)
    photos = [
        photo.model_copy(update={"split": "test" if photo.name in test_photos else "train"})
        for photo in manifest.photos
    ]
    views = load_views(Manifest(scene="s", photos=tuple(photos)), model, Views(), Split())
    expected = list(test_photos) or ["p00.jpg", "p08.jpg"]
    assert [view.name for view in views if view.is_test] == expected
