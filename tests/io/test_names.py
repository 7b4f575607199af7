"""The photographs that names in other programs' files mean."""

from __future__ import annotations

import unicodedata
from pathlib import PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.io.names import NameIndex, compare_names, match_names, stem_key
from pipeline.runtime.errors import UserError

NFC, NFD = (unicodedata.normalize(form, "Köln_é.JPG") for form in ("NFC", "NFD"))


@pytest.mark.parametrize(
    "photos, name, expected",
    [
        (["a.jpg", "b.jpg"], "a.jpg", ["a.jpg"]),
        (["a.jpg", "A.jpg"], "A.jpg", ["A.jpg"]),
        (["a.jpg"], "./a", ["a.jpg"]),
        (["a.JPG", "a.png"], "a.jpg", ["a.JPG"]),
        (["a.jpg", "a.png"], "a", ["a.jpg", "a.png"]),
        (["x.jpg", "X.png"], "X", ["X.png"]),
        (["x.jpg", "X.jpg"], "x.png", ["x.jpg"]),
        ([NFD], NFC, [NFD]),
        ([NFC], NFD.lower(), [NFC]),
        (["front/1.jpg", "back/1.jpg"], "1.jpg", ["back/1.jpg", "front/1.jpg"]),
        (["front/1.jpg", "back/1.jpg"], "/home/me/front/1.png", ["front/1.jpg"]),
        (["front/1.jpg", "back/1.jpg"], "D:\\flight\\back\\1.JPG", ["back/1.jpg"]),
        (["front/1.jpg", "back/1.jpg"], "side/1.jpg", ["back/1.jpg", "front/1.jpg"]),
        (["front/1.jpg", "back/2.jpg"], "front/2.jpg", []),  # front/2.jpg was deleted.
        (["new/1.jpg"], "old/1.jpg", ["new/1.jpg"]),
        (["1.jpg"], "old/1.jpg", ["1.jpg"]),
        (["a/1.jpg", "1.jpg"], "b/a/1.jpg", ["a/1.jpg"]),
        (["a.jpg"], "b.jpg", []),
        (["r_0.5.png", "r_0.png"], "./r_0.5", ["r_0.5.png"]),
    ],
)
def test_names_mean_photographs(photos, name, expected):
    index = NameIndex(photos)
    assert index.candidates(name) == expected
    assert index.find(name) == (expected[0] if len(expected) == 1 else None)


def test_a_deleted_photograph_does_not_get_the_name_of_another_folder():
    """A rig without one photograph: its pose belongs to no other."""
    photos = ["left/1.jpg", "left/2.jpg", "right/1.jpg"]
    listed = [*photos, "right/2.jpg"]
    assert match_names(listed, photos, "f") == {name: name for name in photos}


def test_equal_names_in_several_folders_are_the_same_positions():
    photos = [f"{light}/{i}.jpg" for light in ("day", "night") for i in range(3)]
    found = match_names(["0.jpg", "1.jpg", "2.jpg"], photos, "f")
    assert found == {photo: PurePosixPath(photo).name for photo in photos}


@pytest.mark.parametrize(
    "listed, photos, named",
    [
        (["1", "2", "1", "2"], ["a/1.jpg", "a/2.jpg", "b/1.jpg", "b/2.jpg"], "a/1.jpg, b/1.jpg"),
        (["1", "2", "3"], ["a/1.jpg", "a/2.jpg", "b/2.jpg", "b/3.jpg"], "a/2.jpg, b/2.jpg"),
        (["a/1", "b/1"], ["1.jpg"], "a/1, b/1"),
        (["1.tif", "1.jpg"], ["1.png"], "1.jpg, 1.tif"),
        (["1.jpg", "1.jpg"], ["1.jpg"], "1.jpg is listed 2 times"),
        (["1"], ["1.png", "1.jpg"], "1.jpg, 1.png"),
        ([NFC, NFD], ["Köln_é.png"], "2 names may mean"),
    ],
)
def test_ambiguous_names_are_an_error_that_names_both(listed, photos, named):
    with pytest.raises(UserError, match="expected one pose for each photograph") as error:
        match_names(listed, photos, "cameras.xml")
    assert named in str(error.value) and "cameras.xml" in str(error.value)


PARTS = st.sampled_from(["a", "b", "DJI_0001", "é", "e\u0301", "É", "x.y", "left", "right"])
SUFFIXES = st.sampled_from(["", ".jpg", ".JPG", ".png", ".dng"])


@st.composite
def file_names(draw):
    folders = draw(st.lists(PARTS, max_size=2))
    return "/".join([*folders, draw(PARTS) + draw(SUFFIXES)])


@given(st.lists(file_names(), max_size=8, unique=True), st.lists(file_names(), max_size=8))
def test_matches_do_not_depend_on_the_order_and_lose_nothing(photos, listed):
    matches = compare_names(listed, photos)
    reverse = compare_names(listed[::-1], photos[::-1])
    assert matches.names == reverse.names
    assert {(a.listed, a.photos) for a in matches.ambiguous} == {
        (a.listed, a.photos) for a in reverse.ambiguous
    }
    for photo, name in matches.names.items():
        assert photo in photos and listed.count(name) == 1
        assert stem_key(photo).split("/")[-1] == stem_key(name).split("/")[-1]
    unclear = {name for ambiguity in matches.ambiguous for name in ambiguity.listed}
    for name in set(listed) & set(photos):
        # The same name: its photograph, or listed twice.
        assert matches.names.get(name) == name or name in unclear


@given(st.lists(file_names(), min_size=1, max_size=8, unique=True), st.data())
def test_find_is_unique_and_independent_of_normal_forms(photos, data):
    index = NameIndex(photos)
    name = data.draw(file_names())
    found = index.candidates(name)
    assert set(found) <= set(photos) and index.find(name) in (*found, None)
    for form in ("NFC", "NFD"):
        other = unicodedata.normalize(form, name)
        if name not in photos and other not in photos:
            assert index.candidates(other) == found
