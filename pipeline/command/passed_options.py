"""The options of ``splatmake run`` that are Snakemake's, and those that are nobody's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from pipeline.command.parser import Parser
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import COMMAND
from pipeline.runtime.suggest import did_you_mean, nearest


def check_passed_options(words: Sequence[str], own: Parser) -> None:
    """Check the words that are passed to Snakemake, which otherwise prints all its options.

    Args:
        words: The words that the command does not know.
        own: The parser of the command.

    Raises:
        UserError: Snakemake has no such option, it takes no such value, or a word belongs to no
            option.
    """
    if not words:
        return
    from snakemake.cli import get_argument_parser
    from snakemake.exceptions import CliException

    parser = get_argument_parser()

    def error(message: str) -> NoReturn:
        fix = f"name FOLDER before further options; see {own.prog} --help"
        raise UserError(message.removeprefix("argument "), fix=fix)

    parser.error = error
    try:
        found, unknown = parser.parse_known_args(list(words))
    except CliException as refused:
        error(str(refused.msg))
    options = [word for word in unknown if word.startswith("-")]
    if options:
        name, _, value = options[0].partition("=")
        after = next(iter(words[words.index(options[0]) + 1 :]), "-")
        # FOLDER may follow instead of the value.
        value = value or ("VALUE" if after.startswith("-") or Path(after).exists() else after)
        theirs = [n for action in parser._actions for n in action.option_strings if n[:2] == "--"]
        error(f"unknown option {name}{did_you_mean(_meant(name, value, own.options(), theirs))}")
    extra = [word for word in (*unknown, *found.targets) if not word.startswith("results/")]
    if extra:
        raise UserError(
            f"unexpected argument {extra[0]!r}",
            fix=f"name one FOLDER; for all scenes in a folder: {COMMAND} batch FOLDER",
        )


def _meant(name: str, value: str, own: Sequence[str], theirs: Sequence[str]) -> str | None:
    """The option that was probably meant: the command's, the configuration's or Snakemake's."""
    from pipeline.config.load import Project
    from pipeline.config.names import nearest_option

    path = name.strip("-").replace("-", "_")
    option = nearest_option(Project, path)
    known = {**{n.strip("-"): n for n in theirs}, **{n.strip("-"): n for n in own}}
    if option is not None:
        known.setdefault(option.rpartition(".")[2], f"--config {option}={value}")
    meant = nearest(path.rpartition(".")[2], known)
    return None if meant is None else known[meant]
