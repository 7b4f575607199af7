"""The check of words finds what it is meant to, and nothing else."""

from __future__ import annotations

import tomllib

import pytest

from tests.style.words import LIST, Words, below

WORDS = Words.of(tomllib.loads(LIST.read_text("utf-8")))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("a torch twin of it", "twin"),
        ("Twins differ", "Twins"),
        ("from tests import test_twin", "twin"),
        ("twinkle", None),
        ("open_eye(views)", "open_eye"),
        ("torch.eye(3)", None),
        ("class RowAdam:", "RowAdam"),
        ("Told(1)", "Told"),
        ("told", None),
        ("views kept back", "kept back"),
    ],
)
def test_a_word_is_found_where_no_letter_touches_it(text: str, found: str | None) -> None:
    places = list(WORDS.places("a.py", f"\n{text}\n"))
    assert len(places) == (found is not None)
    if found is not None:
        assert places[0].startswith(f"a.py:2: {found!r}: ")


def test_paths_are_read_too() -> None:
    (place,) = WORDS.places("pipeline/shelf.py", "")
    assert place.startswith("pipeline/shelf.py:0: 'shelf': ")


def test_a_folder_holds_what_lies_in_it() -> None:
    assert [below("docs/a.md", [path]) for path in ("docs", "docs/")] == ["docs", "docs/"]
    assert below("docs.md", ["docs/"]) is None


def test_pending_paths_exist() -> None:
    """A cleaned or moved folder is taken off the list."""
    root = LIST.parents[2]
    assert [path for path in WORDS.pending if not (root / path).exists()] == []
