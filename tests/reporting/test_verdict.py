"""The verdict says what the stages found, and warnings are grouped by cause."""

import pytest

from pipeline.reporting.names import photograph_names
from pipeline.reporting.verdict import grouped_warnings, verdict
from tests.reporting.made import coverage, metrics

OVERFITTING = {"psnr": 20.0, "train_psnr": 33.0}
CASES = [
    ({}, "good", "47 of 49 photographs placed; sharp where photographed"),
    (
        {"registered_images": 49, "psnr": 27.0, "train_psnr": None},
        "good",
        "all 49 photographs placed; sharp where photographed",
    ),
    ({"sfm_verdict": "weak"}, "weak", "placed, but their positions are uncertain; sharp where"),
    (OVERFITTING, "weak", "placed; sharp at the photographs, blurred or wrong between them"),
    ({"train_psnr": 16.0, "psnr": 14.0}, "failed", "the photographs are not reproduced"),
    ({"psnr": 15.0, "train_psnr": None}, "failed", "the photographs are not reproduced"),
]


@pytest.mark.parametrize(("changes", "grade", "words"), CASES)
def test_the_grade_is_the_worst_of_poses_and_renders(changes, grade: str, words: str) -> None:
    found = verdict(metrics(**changes), coverage().record)
    assert found.grade == grade and words in found.sentence
    # Green only if good: the figure of the error has the grade of the renders.
    assert found.figures[1].grade != "good" or not (changes.keys() & {"psnr"} and grade != "good")


@pytest.mark.parametrize(
    ("description", "words"),
    [
        (
            "from a b.jpg, 39% to the left (of it), looking at c.jpg",
            "to the left of a b.jpg",
        ),
        ("from a.jpg, 12% higher, 3% to the right", "above a.jpg"),
        ("between a.jpg and b.jpg, 14% ahead (of it)", "between a.jpg and b.jpg"),
        ("here", ""),
    ],
)
def test_the_sentence_names_what_was_hardly_seen(description: str, words: str) -> None:
    shown = coverage()
    view = shown.record.viewpoints[0].model_copy(
        update={"description": description, "unknown_percent": 70.0}
    )
    record = shown.record.model_copy(update={"viewpoints": (view,)})
    found = verdict(metrics(), record)
    expected = f"what lies {words} was hardly seen" if words else "surroundings were hardly seen"
    assert expected in found.sentence


@pytest.mark.parametrize(("share", "expected"), [(0.04, False), (0.163, True)])
def test_the_sentence_names_contradictions_that_are_conspicuous(share: float, expected) -> None:
    record = coverage().record
    novel = record.novel_views.model_copy(update={"contradicted_share": share})
    record = record.model_copy(update={"novel_views": novel})
    words = "% of what one sees"
    assert (
        f"places, 16 {words} contradicts them" in verdict(metrics(), record).sentence
    ) == expected
    assert (f"; 16 {words} beside the" in record.headline()) == expected


def test_causes_come_before_consequences_and_once() -> None:
    order = ["inspect", "matches", "sfm", "train", "evaluate"]
    groups = grouped_warnings(
        [
            *("it is dark", "evaluate: too few", "sfm: weak: why (to improve it: move; stop)"),
            *("matches: two groups", "sfm: no pose", "it is dark", "sfm: no pose"),
        ],
        order,
    )
    assert [(group.title, *group.warnings) for group in groups] == [
        ("The photographs", "it is dark"),
        ("Finding where they were taken", "two groups", "weak: why", "no pose"),
        ("Measured result", "too few"),
    ]
    assert [list(group.remedies) for group in groups] == [[], ["move", "stop"], []]


def test_views_are_named_by_photographs_unless_two_differ_in_their_suffix_only() -> None:
    views = ["a.png", "sub/b.png", "c.png", "d_left.png", "e.jpg"]
    photographs = ["a.JPG", "sub/b.CR2", "c.jpg", "c.tif", "d.jpg", "e.jpg"]
    assert photograph_names(views, photographs) == {"a.png": "a.JPG", "sub/b.png": "sub/b.CR2"}
