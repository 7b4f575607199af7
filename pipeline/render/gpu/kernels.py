"""The sources of the kernels: WGSL files, their imports, and the constants of the C++ kernels.

A line ``#import name`` is replaced by ``wgsl/name.wgsl``, once. The bindings of a kernel are read
from its declarations, so that they are declared in one place.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

FOLDER = Path(__file__).parent / "wgsl"
CONSTANTS = Path(__file__).parents[1] / "cpu/csrc/constants.h"
# The constants of the method and of the layout that the kernels share with the C++ ones.
SHARED = (
    "kDilation", "kAlphaMin", "kLog2AlphaMin", "kAlphaMax", "kTransmittanceMin", "kQuatNorm2Min",
    "kCompensationMin", "kMinDepthSigmas", "kShMax", "kTile",
)  # fmt: skip

_BINDING = re.compile(
    r"@group\(0\) @binding\((?P<number>\d+)\) var<(?P<kind>uniform|storage)"
    r"(?:, (?P<access>read_write|read))?> (?P<name>\w+):"
)
_CONSTANT = re.compile(r"constexpr (?P<type>double|float|int) (?P<name>k\w+) = (?P<value>[^;]+);")
_ENTRY = re.compile(r"^@compute[^{]*?\bfn (?P<name>\w+)\(.*?^\}$", re.MULTILINE | re.DOTALL)
_IMPORT = re.compile(r"^#import (\w+)$", re.MULTILINE)


@dataclass(frozen=True)
class Binding:
    """One buffer of a kernel.

    Attributes:
        kind: ``uniform``, ``read`` or ``read_write``.
    """

    number: int
    name: str
    kind: str


@dataclass(frozen=True)
class Use:
    """Whether a kernel reads a buffer, and whether it writes to it."""

    read: bool
    written: bool


@dataclass(frozen=True)
class Source:
    """A WGSL module."""

    code: str
    bindings: tuple[Binding, ...]


@cache
def source(name: str, subgroups: bool = False) -> Source:
    """The module ``wgsl/name.wgsl`` with its imports and the constants.

    Args:
        subgroups: Whether ``prefix_subgroups.wgsl`` replaces ``prefix.wgsl``.
    """
    text = (FOLDER / f"{name}.wgsl").read_text("utf-8")
    text = constants() + _with_imports(text, {name}, subgroups)
    bindings = tuple(
        Binding(int(m["number"]), m["name"], m["access"] or "uniform")
        for m in _BINDING.finditer(text)
    )
    return Source(text, bindings)


@cache
def uses(kernel: str) -> dict[str, Use]:
    """The uses of the bindings of a kernel, named as for ``Gpu.run``. Functions that several
    kernels of a module can call count for each of them."""
    name, _, entry = kernel.partition(".")
    code = re.sub(r"//.*", "", source(name).code)
    code = _ENTRY.sub(lambda m: m[0] if m["name"] == (entry or "main") else "", code)
    return {binding.name: _use(binding.name, code) for binding in source(name).bindings}


def _use(name: str, code: str) -> Use:
    # Members of structs can have the same name.
    found = len(re.findall(rf"(?<!\.)\b{name}\b", code)) - 1  # without the declaration
    place = rf"(?m)(?:^|\{{)\s*{name}(?:\[[^=;]*\])?(?:\.\w+)?"
    assigned = len(re.findall(place + " = ", code))
    changed = re.search(place + " [-+*/|&]= ", code) or f"&{name}" in code
    return Use(read=found > assigned, written=assigned > 0 or bool(changed))


@cache
def constants() -> str:
    """The constants of ``constants.h`` in WGSL."""
    found = {m["name"]: m for m in _CONSTANT.finditer(CONSTANTS.read_text("utf-8"))}
    lines = []
    for name in SHARED:
        value = re.sub(r"(?<=\d)f\b", "", found[name]["value"])
        suffix = "u" if found[name]["type"] == "int" else ""
        lines.append(f"const {name} = {value}{suffix};\n")
    return "".join(lines)


def _with_imports(text: str, seen: set[str], subgroups: bool) -> str:
    def replacement(match: re.Match[str]) -> str:
        name = match[1]
        if name in seen:
            return ""
        seen.add(name)
        file = "prefix_subgroups" if subgroups and name == "prefix" else name
        return _with_imports((FOLDER / f"{file}.wgsl").read_text("utf-8"), seen, subgroups)

    return _IMPORT.sub(replacement, text)
