"""Instruction-set targets: what native libraries are compiled for, and which one runs here.

``SPLATMAKE_TARGET`` forces one by name. Otherwise the processor's best is used.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.runtime import processor
from pipeline.runtime.errors import UserError

VARIABLE = "SPLATMAKE_TARGET"


@dataclass(frozen=True)
class Target:
    """A named instruction set.

    Attributes:
        flags: the compiler's (g++ 11 and clang++ 12 or newer know them).
        features: what a processor must have, by Linux's names.
    """

    name: str
    architecture: str
    flags: tuple[str, ...]
    features: frozenset[str] = frozenset()

    @property
    def missing(self) -> list[str]:
        """What this machine lacks of it."""
        if self.architecture != processor.architecture():
            return [f"the {self.architecture} architecture"]
        return sorted(self.features - processor.features())


_V2 = processor.BASELINE["x86-64"]
_V3 = _V2 | {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}
_V4 = _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}

# Of each architecture, from the least to the best.
TARGETS = (
    Target("x86-64-v2", "x86-64", ("-march=x86-64-v2",), _V2),
    Target("x86-64-v3", "x86-64", ("-march=x86-64-v3",), _V3),
    Target("x86-64-v4", "x86-64", ("-march=x86-64-v4",), _V4),
    Target("aarch64", "aarch64", ("-march=armv8-a",), processor.BASELINE["aarch64"]),
)


def native_target() -> Target:
    """Whatever the compiler finds on this very processor. Its libraries serve no other model."""
    architecture = processor.architecture()
    option = "-march=native" if architecture == "x86-64" else "-mcpu=native"
    return Target("native", architecture, (option,))


def named(name: str) -> Target:
    """The target of this name. Raises UserError where there is none."""
    known = {target.name: target for target in (*TARGETS, native_target())}
    if name not in known:
        raise UserError(
            f"unknown instruction-set target {name!r}; expected one of {', '.join(known)}",
            fix=f"correct {VARIABLE} or --target, or leave it out for the processor's best",
        )
    return known[name]


def of_this_architecture() -> list[Target]:
    """All targets a compiler here can build for, best first."""
    here = processor.architecture()
    return [target for target in reversed(TARGETS) if target.architecture == here]


def usable() -> list[Target]:
    """The targets to look for, best first: the forced one alone, else all the processor has.

    Raises:
        UserError: the forced one is unknown or not what the processor has, or it has none.
    """
    if forced := os.environ.get(VARIABLE):
        target = named(forced)
        if target.missing:
            raise UserError(
                f"{VARIABLE}={forced}: this processor ({processor.processor_name()}) lacks "
                f"{', '.join(target.missing)}",
                fix=f"unset {VARIABLE} for the best that it has",
            )
        return [target]
    found = [target for target in of_this_architecture() if not target.missing]
    if not found:
        lacks = [target.missing for target in of_this_architecture()[-1:]]
        why = f"lacks {', '.join(lacks[0])}" if lacks else "has no target of its own"
        raise UserError(
            f"this processor ({processor.processor_name()}) {why}",
            fix=f"set {VARIABLE}=native, which is not tested, or use another machine",
        )
    return found


@dataclass(frozen=True)
class Extension:
    """A feature beyond a target's own that a library has a use for."""

    feature: str
    flags: tuple[str, ...]


@dataclass(frozen=True)
class Variant:
    """What a library is compiled for: a target, perhaps with extensions."""

    target: Target
    extensions: tuple[Extension, ...] = ()

    @property
    def name(self) -> str:
        return "+".join([self.target.name, *(e.feature for e in self.extensions)])

    @property
    def flags(self) -> list[str]:
        """The compiler's; an extension's -march replaces the target's."""
        return [*self.target.flags, *(flag for e in self.extensions for flag in e.flags)]


Extensions = Mapping[str, Sequence[Extension]]


def usable_variants(extensions: Extensions) -> list[Variant]:
    """What to look for, best first: of each usable target the variant with all extensions that
    the processor has, then the one without.

    Args:
        extensions: what a library has a use for, by the target's name.
    """
    available = processor.features()
    found: list[Variant] = []
    for target in usable():
        more = tuple(e for e in extensions.get(target.name, ()) if e.feature in available)
        found += [Variant(target, more)] if more else []
        found.append(Variant(target))
    return found


def all_variants(target: Target, extensions: Extensions) -> list[Variant]:
    """What to build of a target for any processor that has it."""
    more = tuple(extensions.get(target.name, ()))
    return [Variant(target), *([Variant(target, more)] if more else [])]
