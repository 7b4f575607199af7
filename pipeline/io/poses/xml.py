"""XML files with poses of other programs."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

from pipeline.io.bounded import read_bounded
from pipeline.io.bounded_xml import parse_xml
from pipeline.io.poses.files import FIX, MAX_BYTES, malformed


def read_xml(file: Path) -> Element:
    """The root element.

    Raises:
        UserError: too large, not well-formed, nested too deeply, or with a document type.
    """
    try:
        return parse_xml(read_bounded(file, MAX_BYTES, fix=FIX))
    except ValueError as error:
        raise malformed(file, str(error)) from None
