"""XML of other programs, parsed without document types: no entities, nothing else is read."""

from __future__ import annotations

from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

_MAX_DEPTH = 100
# Bytes of memory of an element (a start tag and an end tag, or one) and of an attribute.
_TAG_BYTES, _ATTRIBUTE_BYTES = 100, 120
_MAX_MEMORY = 1 << 30


class _RefusedError(ValueError):
    """A construct that is valid and that no file needs."""


def parse_xml(data: bytes) -> Element:
    """The root element; namespaces become "{address}name" (``ElementTree``).

    Raises:
        ValueError: The XML is not well-formed, nested too deeply, too large, or with a document
            type.
    """
    needed = data.count(b"<") * _TAG_BYTES + data.count(b"=") * _ATTRIBUTE_BYTES
    if needed > _MAX_MEMORY:
        raise ValueError(f"expected XML that takes at most {_MAX_MEMORY >> 20} MiB of memory")
    builder = TreeBuilder()
    depth = 0

    def name(raw: str) -> str:
        return "{" + raw if "}" in raw else raw

    def start(raw: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _MAX_DEPTH:
            raise _RefusedError("not valid XML (nested too deeply)")
        builder.start(name(raw), {name(key): value for key, value in attributes.items()})

    def end(raw: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(name(raw))

    def refuse(*arguments: object) -> None:
        raise _RefusedError("expected XML without a document type (<!DOCTYPE ...>)")

    parser = expat.ParserCreate(namespace_separator="}")
    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(data, True)
        return builder.close()
    except _RefusedError:
        raise
    except (expat.ExpatError, LookupError, AssertionError, ValueError) as error:
        raise ValueError(f"not valid XML ({error})") from None
