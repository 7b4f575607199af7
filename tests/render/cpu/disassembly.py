"""Counts the floating-point instructions of a compiled file, loop by loop, from objdump."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# x86: addps, vfmadd231ps, vcmpltps, ...; the last letters say packed or scalar, float or double.
_X86_ARITHMETIC = re.compile(
    r"v?(?:add|sub|mul|div|min|max|sqrt|fn?m(?:add|sub)\d*|cmp\w*?|u?comi|round|rcp|rsqrt|rndscale)"
    r"([ps])[sd]"
)
_X86_LANE = re.compile(r"v?(?:insertps|extractps|pinsr[bwdq]|pextr[bwdq])")
_X86_STORE = re.compile(r"v?movs[sd]")
# AArch64: fadd v0.4s, ... is packed; fadd s0, ... is scalar.
_ARM_ARITHMETIC = re.compile(r"f(?:add|sub|mul|div|min|max|minnm|maxnm|sqrt|n?m(?:add|sub|la|ls))")
_ARM_COMPARISON = re.compile(r"fcm\w+|frint\w")
_JUMP_X86, _JUMP_ARM = re.compile(r"j\w+"), re.compile(r"b|b\.\w+|cbn?z|tbn?z")
_FUNCTION = re.compile(r"^[0-9a-f]+ <(.*)>:$")
_INSTRUCTION = re.compile(r"^\s*([0-9a-f]+):\t(?:(?:rep|lock|bnd|notrack) )*(\S+)\s*([^<#]*)")


@dataclass(frozen=True)
class Instruction:
    address: int
    name: str
    operands: str

    @property
    def target(self) -> int | None:
        """Target address of a jump inside the file."""
        if not (_JUMP_X86.fullmatch(self.name) or _JUMP_ARM.fullmatch(self.name)):
            return None
        place = self.operands.split(",")[-1].strip()
        return int(place, 16) if re.fullmatch(r"[0-9a-f]+", place) else None

    @property
    def arithmetic(self) -> str | None:
        """``"packed"``, ``"scalar"``, or None if it is not floating-point arithmetic."""
        if found := _X86_ARITHMETIC.fullmatch(self.name):
            return "packed" if found[1] == "p" else "scalar"
        if _ARM_ARITHMETIC.fullmatch(self.name) or _ARM_COMPARISON.fullmatch(self.name):
            return "packed" if self.operands.startswith("v") else "scalar"
        return None

    @property
    def moves_a_lane(self) -> bool:
        """Whether it extracts, inserts or stores a single lane of a vector."""
        if self.name in ("mov", "ins", "umov", "smov", "st1", "ld1"):  # AArch64
            # A move between two vectors is a shuffle.
            return len(re.findall(r"v\d+\.[sd]\}?\[\d\]", self.operands)) == 1
        stored = _X86_STORE.fullmatch(self.name) and self.operands.endswith(")")
        return bool(stored or _X86_LANE.fullmatch(self.name))


@dataclass(frozen=True)
class Loop:
    """An innermost loop: its floating-point arithmetic, and moves of single lanes."""

    function: str
    packed: int
    scalar: int
    lane_moves: int

    @property
    def arithmetic(self) -> int:
        return self.packed + self.scalar


def innermost_loops(objdump: str, path: Path) -> list[Loop]:
    """All of an object file."""
    command = [objdump, "--disassemble", "--no-show-raw-insn", "--demangle", "--wide", str(path)]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return [loop for name, body in _functions(text) for loop in _loops(name, body)]


def _functions(text: str) -> Iterator[tuple[str, list[Instruction]]]:
    name, body = "", []
    for line in text.splitlines():
        if found := _FUNCTION.match(line):
            yield name, body
            name, body = found[1], []
        elif found := _INSTRUCTION.match(line):
            body.append(Instruction(int(found[1], 16), found[2], found[3].strip()))
    yield name, body


def _loops(name: str, body: list[Instruction]) -> Iterator[Loop]:
    """Ranges that end with a backward jump and contain no other such range."""
    place = {instruction.address: i for i, instruction in enumerate(body)}
    ranges = {
        (place[i.target], last)
        for last, i in enumerate(body)
        if i.target in place and place[i.target] <= last
    }
    for first, last in ranges:
        inside = (r for r in ranges if r != (first, last))
        if any(first <= begin and end <= last for begin, end in inside):
            continue
        part = body[first : last + 1]
        kinds = [instruction.arithmetic for instruction in part]
        yield Loop(
            name,
            kinds.count("packed"),
            kinds.count("scalar"),
            sum(instruction.moves_a_lane for instruction in part),
        )
