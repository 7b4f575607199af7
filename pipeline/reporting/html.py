"""HTML from the files in ``templates/``, in which every value is escaped."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from pipeline.reporting.text import count, duration, fixed, plain

_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).with_name("templates")),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
)
_TEMPLATES.filters |= {"fixed": fixed, "count": count, "duration": duration, "plain": plain}
_TEMPLATES.filters["px"] = lambda value: f"{value:.1f}"


class Section(NamedTuple):
    """A section of a page.

    Attributes:
        key: The anchor that the navigation links to.
        title: The heading.
        template: The file in ``templates/`` that shows ``content``.
        content: The values of the section, as ``section.content`` in its template.
    """

    key: str
    title: str
    template: str
    content: Any = None


def render(template: str, **values: Any) -> Markup:
    """Fill in a template. The same values give the same bytes."""
    return Markup(_TEMPLATES.get_template(template).render(values))
