"""Poses of other programs in a whole scene folder: names, large coordinates, paths outside."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pipeline.runtime.errors import UserError
from tests.io.poses.known import HEIGHT, UTM, WIDTH, known_scene, opencv
from tests.io.poses.test_metashape import calibration, export
from tests.io.poses.test_photogrammetry import openmvg_json
from tests.pictures import picture
from tests.plan.test_scan import given_model, look, names

SIZE = (WIDTH, HEIGHT)


def photographs(folder, count: int = 4) -> None:
    for i in range(count):
        picture(folder / "images" / f"p{i}.jpg", size=SIZE)


def test_metashape_in_utm_coordinates(tmp_path):
    photographs(tmp_path)
    known = known_scene(opencv(-0.1, 0.03, 1e-3, -2e-3), origin=UTM, names="P{}")
    (tmp_path / "cameras.xml").write_text(export(known, calibration(known.cameras[1])))
    found = look(tmp_path)
    assert found.poses is not None
    assert found.poses.label == "Metashape cameras cameras.xml, 4 cameras"
    assert (found.poses.models, found.poses.pinhole) == (("OPENCV",), False)
    given = given_model(found)
    images = given.model.by_name()
    assert sorted(images) == names(found) == [f"p{i}.jpg" for i in range(4)]
    expected = known.by_name()
    shift = {n: image.centre - expected[n[:2].upper()].centre for n, image in images.items()}
    spread = np.ptp(np.stack(list(shift.values())), axis=0)
    assert np.abs(next(iter(images.values())).centre).max() < 100 and spread.max() < 1e-6


def test_a_changed_pose_file_changes_the_fingerprint(tmp_path):
    photographs(tmp_path)
    file = tmp_path / "sfm_data.json"
    file.write_text(openmvg_json(known_scene(opencv())))
    before = look(tmp_path)
    file.write_text(openmvg_json(known_scene(opencv(), origin=np.ones(3))))
    after = look(tmp_path)
    assert before.poses is not None and before.poses.kind == "openmvg"
    assert before.fingerprint != after.fingerprint


@pytest.mark.parametrize("name", ["../../outside/p{}.jpg", "/etc/p{}.jpg", "C:\\p{}.jpg"])
def test_names_outside_of_the_folder_only_name_photographs_inside(tmp_path, name):
    scene = tmp_path / "a" / "scene"
    photographs(scene, 3)
    for i in range(4):
        picture(tmp_path / "outside" / f"p{i}.jpg", size=SIZE)
    (scene / "sfm_data.json").write_text(openmvg_json(known_scene(opencv(), names=name)))
    found = look(scene)
    assert all(photo.path.startswith(str(scene / "images")) for photo in found.photos)
    assert sorted(given_model(found).model.by_name()) == ["p0.jpg", "p1.jpg", "p2.jpg"]


def test_a_pose_file_of_other_photographs_is_an_error(tmp_path):
    photographs(tmp_path)
    (tmp_path / "sfm_data.json").write_text(openmvg_json(known_scene(opencv(), names="q{}.jpg")))
    with pytest.raises(UserError, match="none of its 4 images is a photograph"):
        look(tmp_path)


def two_flights(tmp_path, groups: tuple[str, str]):
    """Metashape's cameras of two groups with the same labels, and their photographs in two
    folders."""
    known = known_scene(opencv(), names="p{}")
    for folder in ("front", "back"):
        for i in range(2):
            picture(tmp_path / "images" / folder / f"p{i}.jpg", size=SIZE)
    text = export(known, calibration(known.cameras[1]))
    text = re.sub(r"</?group[^>]*>", "", text)
    for i, label in ((2, "p0"), (3, "p1")):
        text = text.replace(f'label="p{i}"', f'label="{label}"')
    head, *cameras = text.split("<camera ")
    last, tail = cameras[3].split("</camera>", 1)
    cameras[3] = f"{last}</camera>"
    first, second = ("".join(f"<camera {c}" for c in cameras[i : i + 2]) for i in (0, 2))
    text = (
        f'{head}<group id="0" label="{groups[0]}">{first}</group>'
        f'<group id="1" label="{groups[1]}">{second}</group>{tail}'
    )
    (tmp_path / "cameras.xml").write_text(text)
    return known.by_name()


def test_cameras_of_groups_with_equal_labels_are_those_of_their_folders(tmp_path):
    known = two_flights(tmp_path, ("back", "front"))
    found = look(tmp_path)
    images = given_model(found).model.by_name()
    order = ("back/p0.jpg", "back/p1.jpg", "front/p0.jpg", "front/p1.jpg")
    assert sorted(images) == sorted(order) and not found.warnings
    centres = np.stack([images[name].centre for name in order])
    expected = np.stack([known[f"p{i}"].centre for i in range(4)])
    np.testing.assert_allclose(np.diff(centres, axis=0), np.diff(expected, axis=0), atol=1e-6)


@pytest.mark.parametrize("groups", [("Group 1", "Group 2"), ("front", "front"), ("", "")])
def test_equal_labels_whose_groups_are_no_folders_are_an_error(tmp_path, groups):
    two_flights(tmp_path, groups)
    with pytest.raises(UserError, match="expected one pose for each photograph") as error:
        look(tmp_path)
    assert "p0" in str(error.value) and "cameras.xml" in str(error.value)
