"""Instruction set and compiler of the measured kernels, stated with every table."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from typing import Any

from pipeline.render.cpu import build
from pipeline.runtime.machine import machine_facts

# The compiler's macro of each instruction set, best first, and the float32 lanes of its registers.
INSTRUCTION_SETS = (
    ("__AVX512F__", "AVX-512", 16),
    ("__AVX2__", "AVX2", 8),
    ("__AVX__", "AVX", 8),
    ("__SSE4_2__", "SSE4.2", 4),
    ("__SSE2__", "SSE2", 4),
    ("__ARM_NEON", "NEON", 4),
)


@dataclass(frozen=True)
class Library:
    """The library of kernels that is measured.

    Attributes:
        target: One of ``pipeline.runtime.targets``.
        instruction_set: The widest instruction set that the kernels may use.
        lanes: The float32 lanes of its registers.
        compiler: The name and version of the compiler.
    """

    target: str
    instruction_set: str
    lanes: int
    compiler: str


def measured_library() -> Library:
    """The library that this process loads."""
    built = build.load()
    command = [*build.compiler(), *build.flags(built.target), "-x", "c++", "-dM", "-E", "/dev/null"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    macros = done.stdout.split()
    _, name, lanes = next(found for found in INSTRUCTION_SETS if found[0] in macros)
    return Library(built.target, name, lanes, built.compiler)


def library_facts(library: Library) -> dict[str, Any]:
    """The library, as data."""
    return {
        "target": library.target,
        "instruction_set": library.instruction_set,
        "compiler": library.compiler,
    }


def heading(library: Library) -> str:
    """The heading of a table."""
    facts = machine_facts()
    return (
        f"{facts['processor']}, {facts['cores']} cores; kernels for {library.target} "
        f"({library.instruction_set}) by {library.compiler}"
    )
