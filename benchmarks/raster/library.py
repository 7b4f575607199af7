"""What the measured kernels are compiled for, and by what: every table says so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pipeline.raster import build
from pipeline.runtime.machine import machine_facts

LANES = {"x86-64-v4": 16, "x86-64-v3": 8, "x86-64-v2": 4, "aarch64": 4}


@dataclass(frozen=True)
class Library:
    """Attributes:
    target: the instruction set that the kernels are compiled for.
    lanes: float32 lanes of its registers.
    compiler: name and version.
    """

    target: str
    lanes: int
    compiler: str


def measured_library() -> Library:
    """Of the kernels that this process loads."""
    built = build.load()
    target = built.target.partition("+")[0]
    return Library(target, LANES.get(target, 4), built.compiler)


def measured_on(library: Library) -> dict[str, Any]:
    """The machine and the library, as data."""
    return {
        "machine": machine_facts(),
        "target": library.target,
        "compiler": library.compiler,
    }


def heading(library: Library) -> str:
    """The same, as a line above a table."""
    facts = machine_facts()
    return (
        f"{facts['processor']}, {facts['cores']} cores; kernels for {library.target} "
        f"by {library.compiler}"
    )

