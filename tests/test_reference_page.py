"""The page of the command line is the parser's."""

from pipeline.command.reference_page import PAGE, page


def test_the_page_is_current() -> None:
    assert PAGE.read_text() == page(), "run make docs"
