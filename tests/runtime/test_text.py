"""Messages have a bounded length, whatever they quote."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.runtime.errors import UserError
from pipeline.runtime.text import shortened, shown, without_middle

ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@settings(max_examples=300, deadline=None)
@given(ANYTHING, st.integers(0, 200))
def test_a_value_is_shown_on_one_line(value, limit):
    text = shown(value, limit)
    assert len(text) <= 12 * limit + 30  # A character may take ten, as "\U0001f600" may.
    assert text.isprintable()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("a.jpg", "'a.jpg'"),
        ("a" * 100, "'" + "a" * 60 + "..."),
        pytest.param(10**5000, "a number of thousands of digits", id="digits"),
        ([1, 2], "[1, 2]"),
        (None, "None"),
        ("a\nb", r"'a\nb'"),
    ],
)
def test_values_as_messages_show_them(value, text):
    assert shown(value) == text


def test_a_list_of_millions_takes_no_time():
    assert len(shown([[0] * 10**6] * 10**6)) < 70


@pytest.mark.parametrize("text", ["", "a", "b" * 99, "x" * 10**6])
def test_shortened_texts(text):
    assert len(shortened(text, 50)) <= 53
    assert len(without_middle(text, 50)) == min(len(text), 50)


CONTENTS = {
    "digits": "9" * 10**5,
    "letters": "a" * 10**4,
    "nul": "\0" * 5000,
    "lines": "line\n" * 500,
    "marks": "\u202e" * 3000,
    "emoji": "\U0001f600" * 3000,
}


@pytest.mark.parametrize("what", CONTENTS)
@pytest.mark.parametrize("other", CONTENTS)
def test_a_message_can_be_read(what, other):
    error = UserError(
        f"start {CONTENTS[what]} end", file=f"/a/{CONTENTS[other]}/b", fix=f"do {CONTENTS[other]}"
    )
    # As after another process.
    for shown_error in (error, UserError(error.what, file=error.file, fix=error.fix)):
        text = str(shown_error)
        assert len(text) < 2000
        assert all(c.isprintable() or c == "\n" for c in text)
        assert "start" in text and "/b: " in text and "what to do: do" in text


def test_the_lines_of_a_long_message_are_counted():
    text = str(UserError("0 of 300 can be used" + "".join(f"\n  {i}.jpg" for i in range(300))))
    assert "\n  0.jpg" in text and "more lines" in text and len(text) < 2000
