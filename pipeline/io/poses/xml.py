"""XML of other programs, parsed without document types: no entities, nothing read or expanded."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from pipeline.io.poses.files import MAX_BYTES, malformed

_MAX_DEPTH = 100


class _Refused(Exception):
    """A construct that no list of cameras needs."""


def read_xml(file: Path) -> Element:
    """The root element.

    Raises:
        UserError: too large, not well-formed, nested too deeply, or with a document type.
    """
    if file.stat().st_size > MAX_BYTES:
        raise malformed(file, f"expected at most {MAX_BYTES >> 20} MiB")
    try:
        return parse_xml(file.read_bytes())
    except _Refused as error:
        raise malformed(file, str(error)) from None
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:
        raise malformed(file, f"not valid XML ({error})") from None


def parse_xml(data: bytes) -> Element:
    """The root element; namespaces become "{address}name" (``ElementTree``)."""
    builder = TreeBuilder()
    depth = 0

    def name(raw: str) -> str:
        return "{" + raw if "}" in raw else raw

    def start(raw: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _MAX_DEPTH:
            raise _Refused("not valid XML (nested too deeply)")
        builder.start(name(raw), {name(key): value for key, value in attributes.items()})

    def end(raw: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(name(raw))

    def refuse(*arguments: object) -> None:
        raise _Refused("expected XML without a document type (<!DOCTYPE ...>)")

    parser = expat.ParserCreate(namespace_separator="}")
    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.Parse(data, True)
    return builder.close()
