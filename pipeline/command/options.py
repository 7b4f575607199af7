"""``splatmake options``: the options of the configuration, as on the reference pages."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

from pipeline.config import docs
from pipeline.config.load import Project
from pipeline.config.names import all_names, hint
from pipeline.config.options import sections_of
from pipeline.runtime.errors import UserError


def describe(names: Sequence[str]) -> list[str]:
    """The options with their values, units, defaults and meanings, as lines of text.

    Args:
        names: The dotted paths of options or sections; empty for the defaults of all options, as a
            configuration file in YAML.

    Raises:
        UserError: There is no such option.
    """
    if not names:
        return docs.defaults().splitlines()
    known = list(all_names(Project))
    for name in names:
        if name not in known:
            raise UserError(
                f"there is no option {name}{hint(Project, name, None)}",
                fix="see the list of all options, without a name",
            )
    wanted = [path for path in known if any(path == n or path.startswith(f"{n}.") for n in names)]
    return [line for path in wanted for line in _option(path)]


def _option(path: str) -> Iterator[str]:
    *sections, name = path.split(".")
    models: tuple[type, ...] = (Project,)
    for section in sections:
        models = sections_of(docs.fields_of(models)[section][0])
    fields = docs.fields_of(models)[name]
    if sections_of(fields[0]):
        return
    values, unit, default, meaning = docs.cells(name, fields, models)
    yield f"{path}: {values}{f' {unit}' if unit else ''} (default: {default})".replace("`", "")
    yield from textwrap.wrap(
        meaning.replace("`", ""), 76, initial_indent="  ", subsequent_indent="  "
    )
