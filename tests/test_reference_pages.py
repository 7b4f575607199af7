"""Generated reference pages are those of the parser and of the schemas."""

from pathlib import Path

import pytest

from pipeline.command.reference_pages import pages


@pytest.mark.parametrize("path", pages(), ids=lambda path: path.name)
def test_the_page_is_current(path: Path) -> None:
    assert path.read_text() == pages()[path], "run make docs"
