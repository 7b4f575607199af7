"""Files that stages exchange: read as they were written; damaged ones are one clear error."""

from __future__ import annotations

import json
import math
import os
import struct
from pathlib import Path
from typing import ClassVar, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field, RootModel, ValidationError

from pipeline.runtime.errors import UserError
from pipeline.runtime.json_file import JsonFile, JsonObject, Vector3


class Part(JsonObject):
    name: str
    values: dict[float, float]


class Content(JsonFile, JsonObject):
    file_name: ClassVar[str] = "content.json"

    schema_version: Literal[1] = 1
    number: float = Field(ge=-1)
    place: Vector3 | None
    parts: tuple[Part, ...]


class Numbers(JsonFile, RootModel[tuple[float, ...]]):
    file_name: ClassVar[str] = "numbers.json"


CONTENT = Content(
    number=0.1 + 0.2, place=(1.0, -0.0, 1e-310), parts=(Part(name="ä", values={5.0: 1 / 3}),)
)
# A stage's folder in that of a scene.
FOLDER = Path("results") / "barn" / "evaluate"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    CONTENT.write(tmp_path / FOLDER)
    return tmp_path / FOLDER


def test_what_is_read_is_what_was_written(folder: Path) -> None:
    assert Content.read(folder) == CONTENT
    before = (folder / "content.json").read_bytes()
    Content.read(folder).write(folder)
    assert (folder / "content.json").read_bytes() == before


def doubles() -> st.SearchStrategy[float]:
    """All finite bit patterns, where hypothesis prefers simple numbers."""
    patterns = st.binary(min_size=8, max_size=8).map(lambda b: float(struct.unpack("<d", b)[0]))
    return patterns.filter(math.isfinite)


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.lists(doubles(), max_size=200))
def test_floats_keep_every_bit(tmp_path_factory: pytest.TempPathFactory, values) -> None:
    folder = tmp_path_factory.mktemp("numbers")
    Numbers(tuple(values)).write(folder)
    found = Numbers.read(folder).root
    assert struct.pack(f"{len(values)}d", *found) == struct.pack(f"{len(values)}d", *values)


def test_a_truncated_file_is_an_error_at_any_length(folder: Path) -> None:
    file = folder / "content.json"
    whole = file.read_bytes()
    for length in range(len(whole.rstrip())):
        file.write_bytes(whole[:length])
        with pytest.raises(UserError, match=r"content\.json: expected Content .* found a damaged"):
            Content.read(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema_version": 2}, "schema_version: Input should be 1, found 2"),
        ({"number": "much"}, "number: Input should be a valid number.*, found 'much'"),
        ({"number": -2}, "number: Input should be greater than or equal to -1, found -2"),
        ({"squares": 3}, "squares: Extra inputs are not permitted, found 3"),
        ({"place": [1, 2]}, "place.2: Field required"),
        ({"parts": [{"name": "a"}]}, "parts.0.values: Field required"),
        ({"place": ["long" * 99] * 3}, r"found 'long.{,60}\.\.\."),
        (["a", "list"], "found .'a', 'list'."),
    ],
)
def test_a_foreign_file_is_one_error_that_names_the_stage_to_rerun(
    folder: Path, change: object, message: str
) -> None:
    file = folder / "content.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | change if isinstance(change, dict) else change))
    with pytest.raises(UserError, match=message) as caught:
        Content.read(folder)
    assert caught.value.file == file and caught.value.fix is not None
    assert "--forcerun evaluate" in caught.value.fix and "barn/metrics.json" in caught.value.fix
    assert "\n" not in caught.value.what


def test_a_file_without_its_version_is_an_error(folder: Path) -> None:
    file = folder / "content.json"
    content = json.loads(file.read_text())
    del content["schema_version"]
    file.write_text(json.dumps(content))
    with pytest.raises(UserError, match="schema_version: Field required"):
        Content.read(folder)


def test_text_in_another_encoding_is_an_error(folder: Path) -> None:
    (folder / "content.json").write_bytes('{"number": "ä"}'.encode("latin-1"))
    with pytest.raises(UserError, match="damaged"):
        Content.read(folder)


def test_a_missing_file_is_an_error(folder: Path) -> None:
    (folder / "content.json").unlink()
    with pytest.raises(UserError, match=r"content\.json: expected an output of stage evaluate"):
        Content.read(folder)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_numbers_that_are_not_finite_cannot_be_written(value: float) -> None:
    with pytest.raises(ValidationError, match="finite"):
        Content(number=value, place=None, parts=())


def test_contents_do_not_change() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        CONTENT.number = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("kind", ["pipe", "sparse"])
def test_a_file_without_end_is_an_error_at_once(tmp_path, kind):
    file = tmp_path / Content.file_name
    if kind == "pipe":
        os.mkfifo(file)
    else:
        file.touch()
        os.truncate(file, 4 << 40)
    with pytest.raises(UserError, match="expected a file of at most 512 MiB"):
        Content.read(tmp_path)
