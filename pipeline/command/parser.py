"""The parser of the command line: one message for each wrong word, and the types of arguments."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any, NoReturn

from pipeline.render.registry import DEVICE
from pipeline.runtime.errors import UserError
from pipeline.runtime.suggest import did_you_mean, nearest

# The largest whole number that an argument takes.
_MAX_NUMBER = 1_000_000
_MISSING = "the following arguments are required: "
_CHOICE = re.compile(r"argument (.+): invalid choice: (.+) \(choose from (.+)\)", re.DOTALL)


class _Formatter(argparse.HelpFormatter):
    """Names the value of an option once, and keeps the lines of examples."""

    def _format_action_invocation(self, action: argparse.Action) -> str:
        if not action.option_strings or action.nargs == 0:
            return super()._format_action_invocation(action)
        value = self._format_args(action, action.dest.upper())
        return f"{', '.join(action.option_strings)} {value}"

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if "\n" in text else super()._fill_text(text, width, indent)


class Parser(argparse.ArgumentParser):
    """An ``ArgumentParser`` whose errors are raised as ``UserError``."""

    def __init__(self, **options: Any):
        # Abbreviations could be options of Snakemake.
        super().__init__(formatter_class=_Formatter, allow_abbrev=False, **options)

    def format_help(self) -> str:
        self.usage = self.short_usage().replace("%", "%%")
        return super().format_help()

    def short_usage(self) -> str:
        """The arguments that must be given."""
        needed = [action for action in self._actions if action.required]
        needed = sorted(needed, key=lambda action: bool(action.option_strings))
        words = [word for a in needed for word in (*a.option_strings[-1:], _value_name(a))]
        return " ".join([self.prog, *words, "[OPTIONS]"])

    def error(self, message: str) -> NoReturn:
        fix = f"see {self.prog} --help"
        if choice := _CHOICE.fullmatch(message):
            argument, found, names = choice[1], choice[2].strip("'\""), choice[3].replace("'", "")
            meant = did_you_mean(nearest(found, names.split(", ")))
            if argument == "COMMAND":
                if Path(found).is_dir():
                    meant = did_you_mean(f"{self.prog} run {found}")
                raise UserError(f"there is no command {found!r}{meant}", fix=fix)
            message = f"{argument}: expected one of {names}, found {found!r}{meant}"
        if message.startswith(_MISSING):
            message, fix = f"missing {message[len(_MISSING) :]}", f"{self.short_usage()}; {fix}"
        raise UserError(message.removeprefix("argument "), fix=fix)

    def options(self) -> list[str]:
        """The long names of the options."""
        names = (name for action in self._actions for name in action.option_strings)
        return [name for name in names if name.startswith("--")]

    def unknown(self, words: list[str]) -> NoReturn:
        """Raises: UserError: these words are not arguments of the command."""
        name = words[0].partition("=")[0]
        if not name.startswith("-"):
            self.error(f"unexpected argument {name!r}")
        self.error(f"unknown option {name}{did_you_mean(nearest(name, self.options()))}")


def _value_name(action: argparse.Action) -> str:
    return str(action.metavar or "|".join(action.choices or [action.dest.upper()]))


def device(text: str) -> str:
    if not DEVICE.fullmatch(text):
        raise argparse.ArgumentTypeError(f"expected cpu, gpu or gpu:N, found {text!r}")
    return text


def share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 1, found {text!r}")
    return value


def positive(text: str) -> int:
    return _whole_number(text, (0,), "a positive whole number")


def gaussians(text: str) -> int:
    from pipeline.config.section import MAX_GAUSSIANS

    return _whole_number(text, (0,), "a positive whole number", MAX_GAUSSIANS)


def cores(text: str) -> str:
    return text if text == "all" else str(_whole_number(text, (0,), "a number of cores or all"))


def every(text: str) -> int:
    return _whole_number(text, (1,), "0, 2 or more")


def listed(text: str) -> list[str]:
    """The parts of a text that commas separate."""
    return [part.strip() for part in text.split(",") if part.strip()]


def seeds(text: str) -> list[int]:
    return [_whole_number(part, (), "whole numbers, as in 0,1,2") for part in listed(text)]


def entry(text: str) -> str:
    if "=" not in text:
        raise UserError(
            f"--config: expected NAME=VALUE, found {text[:80]!r}",
            fix="name FOLDER before --config, and quote values with spaces, as in --config "
            "'train={steps: 2000}', or write --config train.steps=2000",
        )
    return text


def _whole_number(
    text: str, refused: tuple[int, ...], expected: str, largest: int = _MAX_NUMBER
) -> int:
    number = int(text) if text.isdecimal() and len(text) <= 10 else -1
    if not 0 <= number <= largest or number in refused:
        expected += f", at most {largest}" if number > largest else ""
        raise argparse.ArgumentTypeError(f"expected {expected}, found {text[:40]!r}")
    return number
