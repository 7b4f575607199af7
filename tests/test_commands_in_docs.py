"""Commands in the docs are commands: programs, modules, options, targets and values exist.

``tests/e2e/test_tiny_scene.py`` plans those of Snakemake.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import re
import runpy
import sys

import pytest
from snakemake.cli import get_argument_parser, parse_config

from pipeline.command.config_entries import as_snakemake_reads
from pipeline.command.main import WORKFLOW_COMMANDS, _parse
from pipeline.config.load import load_project
from tests.documented import CHECKED, NOT_CHECKED, PAGES, Command, commands
from tests.e2e.harness import ROOT

COMMANDS = list(dict.fromkeys(commands()))
TARGETS = re.compile(
    r"results/(benchmark\.(csv|json)|[^/]+/(accepted\.json|metrics\.json|plan\.json|report\.html))"
)


def of(program: str) -> list[Command]:
    return [command for command in COMMANDS if command.program == program]


def test_every_page_of_commands_is_read():
    assert len(COMMANDS) > 40
    silent = {page for page in PAGES if page not in {command.page for command in COMMANDS}}
    assert silent == {"docs/guides/add-a-backend.md", "docs/guides/masks.md"}
    assert {command.program for command in COMMANDS} <= {*CHECKED, *NOT_CHECKED}


@pytest.mark.parametrize("command", of("make"), ids=lambda c: c.text)
def test_make(command):
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M)
    assert next(word for word in command.words[1:] if "=" not in word) in targets


@pytest.mark.parametrize("command", of("snakemake"), ids=lambda c: c.text)
def test_snakemake(command):
    check_snakemake(command.words[1:])


def check_snakemake(words: list[str]) -> None:
    """Options are Snakemake's, values the schema's, and targets those of the rules."""
    found = get_argument_parser().parse_args(words)
    assert found.targets
    assert all(TARGETS.fullmatch(target) for target in found.targets)
    load_project(parse_config(found.config or []))
    if found.workflow_profile:
        assert (ROOT / found.workflow_profile / "config.yaml").is_file()


@pytest.mark.parametrize("command", of("splatmake"), ids=lambda c: c.text)
def test_splatmake(command):
    check_splatmake(command.words[1:])


def check_splatmake(words: list[str]) -> None:
    options = _parse(words)
    if words[0] not in WORKFLOW_COMMANDS:
        return
    config = as_snakemake_reads(options["config"])
    others = ["--config", *config] if config else []
    check_snakemake(["results/scene/metrics.json", *options["options"], *others])


@pytest.mark.parametrize("command", of("python"), ids=lambda c: c.text)
def test_python(command, monkeypatch):
    option, module, *words = command.words[1:]
    assert option == "-m"
    if module == "pipeline":
        check_splatmake(words)
        return
    assert importlib.util.find_spec(module) is not None
    flags = {word for word in words if word.startswith("-")}
    if not flags or not module.startswith(("pipeline.", "benchmarks.", "tests.")):
        return
    monkeypatch.setattr(sys, "argv", [module, "--help"])
    monkeypatch.delitem(sys.modules, module, raising=False)
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), pytest.raises(SystemExit):
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    assert flags <= set(re.findall(r"(?<!\S)--?[\w-]+", shown.getvalue()))
