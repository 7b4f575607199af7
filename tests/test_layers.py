"""Imports go one way: a room imports itself and the rooms listed before it, and no module
imports itself through others."""

from __future__ import annotations

import ast
import graphlib
import re
from collections.abc import Collection
from pathlib import Path

import pytest

from tests.rooms import ROOMS as TABLE

ROOT = Path(__file__).parents[1]
ROOMS = tuple(TABLE)
PACKAGES = ("training",)  # hold rooms, and nothing else
MODULES = ("commands", "command", "doctor", "__main__")  # the command line


def room_of(module: str) -> str:
    """The room of a dotted name below ``pipeline``; the name's first part where it has none."""
    inside = [room for room in ROOMS if f"{module}.".startswith(f"{room}.")]
    return inside[0] if inside else module.split(".")[0]


def imports(path: Path) -> set[str]:
    """Every module below ``pipeline`` that a file imports, at its top or inside a function."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: import by the full name"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.removeprefix("pipeline.") for name in found if name.startswith("pipeline.")}


def test_every_module_has_a_room() -> None:
    for path in (ROOT / "pipeline").rglob("*.py"):
        name = ".".join(path.relative_to(ROOT / "pipeline").with_suffix("").parts)
        known = (*ROOMS, *MODULES, "__init__", *(f"{package}.__init__" for package in PACKAGES))
        assert any(f"{name}.".startswith(f"{room}.") for room in known), f"{path} is in no room"


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_rooms_above_it(room: str) -> None:
    allowed = {*ROOMS[: ROOMS.index(room) + 1], *PACKAGES}
    for path in (ROOT / "pipeline").joinpath(*room.split(".")).rglob("*.py"):
        climbs = {name for name in imports(path) if room_of(name) not in allowed}
        assert not climbs, f"{path} imports {sorted(climbs)}"


def test_only_the_render_room_imports_a_backend() -> None:
    """Others use the interface, so that a backend can be added or replaced in one place."""
    for folder in ("pipeline", "stages"):
        for path in (ROOT / folder).rglob("*.py"):
            inside = path.is_relative_to(ROOT / "pipeline" / "render")
            backends = {
                n
                for n in imports(path)
                if n.startswith(("render.cpu", "render.gpu", "render.reference"))
            }
            assert inside or not backends, f"{path} imports {sorted(backends)}"


def module_of(name: str, modules: Collection[str]) -> str | None:
    """The module that an imported name is, or is defined in."""
    while name and name not in modules:
        name = name.rpartition(".")[0]
    return name or None


def test_no_modules_import_each_other() -> None:
    """At their top, for types only, or inside a function."""
    files = {
        ".".join(path.relative_to(ROOT / "pipeline").with_suffix("").parts): path
        for path in (ROOT / "pipeline").rglob("*.py")
    }
    modules = {name.removesuffix(".__init__"): path for name, path in files.items()}
    graph = {
        module: {module_of(name, modules) for name in imports(path)} - {None, module}
        for module, path in modules.items()
    }
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"imports in a cycle: {' <- '.join(error.args[1])}")


def test_the_library_knows_nothing_of_stages() -> None:
    for path in (ROOT / "pipeline").rglob("*.py"):
        text = path.read_text()
        assert not re.search(r"(import|from) (stages|splatmake)\b", text), path
