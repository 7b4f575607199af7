"""The check of words finds what it is meant to, and nothing else."""

from __future__ import annotations

import tomllib

import pytest

from tests.style.words import LIST, Words, below

WORDS = Words.of(tomllib.loads(LIST.read_text("utf-8")))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("two torch twins of it", "twins"),
        ("Pulls differ", "Pulls"),
        ("from tests import test_pace", "pace"),
        ("space", None),
        ("open_eye(views)", "open_eye"),
        ("torch.eye(3)", None),
        ("class Outlook:", "Outlook"),
        ("Told(1)", "Told"),
        ("told", None),
        ("views\tkept\tback", "kept\tback"),
    ],
)
def test_a_word_is_found_where_no_letter_touches_it(text: str, found: str | None) -> None:
    places = list(WORDS.places("a.py", f"\n{text}\n"))
    assert len(places) == (found is not None)
    if found is not None:
        assert places[0].startswith(f"a.py:2: {found!r}: ")


def test_paths_are_read_too() -> None:
    (place,) = WORDS.places("pipeline/pace.py", "")
    assert place.startswith("pipeline/pace.py:0: 'pace': ")


def test_a_folder_holds_what_lies_in_it() -> None:
    assert [below("docs/a.md", [path]) for path in ("docs", "docs/")] == ["docs", "docs/"]
    assert below("docs.md", ["docs/"]) is None


def test_pending_paths_exist() -> None:
    """A cleaned or moved folder is taken off the list."""
    root = LIST.parents[2]
    assert [path for path in WORDS.pending if not (root / path).exists()] == []
