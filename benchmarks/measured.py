"""Records of benchmarks: the results, what they were measured on, and by which command.

Every benchmark takes ``--json FILE`` and ``--note TEXT`` (``add_record_options``).
``benchmarks.tables`` makes the tables of the docs from the records in ``benchmarks/records``.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict

from pipeline.render.cpu import build
from pipeline.runtime.atomic import write_json
from pipeline.runtime.facts import commit
from pipeline.runtime.machine import machine_facts
from pipeline.runtime.native import native_facts

Result = TypeVar("Result")


class Measured(BaseModel):
    """What a benchmark measured on, and how.

    Attributes:
        benchmark: The name of its module, without ``benchmarks.``.
        command: The command that repeats the measurement.
        note: The protocol, or other programs that were running.
        date: The date of the end, ISO 8601.
        commit: The commit of the checkout; None if it is unknown.
        cores: The number of logical cores.
        memory_mb: The memory, MiB.
        load_average: The load of the last minute; None if the system does not provide it.
        instruction_set: The target of the rasterizer's library.
        compiler: The compiler that compiled it, with its version.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    benchmark: str
    command: str
    note: str
    date: str
    commit: str | None
    host: str
    platform: str
    processor: str
    cores: int
    memory_mb: int
    load_average: float | None
    instruction_set: str
    compiler: str


class Record(Measured, Generic[Result]):
    """A record. Its results are dataclasses of ``benchmarks.results`` or ``sfm.summary``."""

    results: list[Result]


def add_record_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", type=Path, metavar="FILE", help="write a record of the results")
    parser.add_argument(
        "--note", default="", help="for the record: the protocol, what else was running"
    )


def measured(benchmark: str, note: str, arguments: Sequence[str] | None = None) -> Measured:
    """Facts about this machine, checkout and command; ``arguments`` are this process's if None."""
    build.library().build()  # Child processes may have used the library, and this one not.
    return Measured(
        benchmark=benchmark,
        command=command_line(benchmark, sys.argv[1:] if arguments is None else arguments),
        note=note,
        date=date.today().isoformat(),
        commit=commit(),
        **machine_facts(),
        **native_facts(),
    )


def command_line(benchmark: str, arguments: Sequence[str]) -> str:
    """The command of a benchmark, with ``FILE`` for its record and without the note."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    add_record_options(parser)
    _, others = parser.parse_known_args(arguments)
    return shlex.join(["python", "-m", f"benchmarks.{benchmark}", *others, "--json", "FILE"])


def write_record(path: Path, facts: Measured, results: Sequence[Any]) -> None:
    """Write the record of ``results``, dataclasses of finite numbers."""
    record = Record[Any](**facts.model_dump(), results=list(results))
    write_json(path, record.model_dump(mode="json"))
