"""Instruction-set targets that native libraries are compiled for.

The best target of the processor is used, or the one that ``SPLATMAKE_TARGET`` names.
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
        flags: The compiler flags (g++ 11, clang++ 12 or newer).
        features: The features that a processor must have, with Linux's names.
    """

    name: str
    architecture: str
    flags: tuple[str, ...]
    features: frozenset[str] = frozenset()

    @property
    def missing(self) -> list[str]:
        """The features that this machine does not have."""
        if self.architecture != processor.architecture():
            return [f"the {self.architecture} architecture"]
        return sorted(self.features - processor.features())


_V2 = processor.BASELINE["x86-64"]
_V3 = _V2 | {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}
_V4 = _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}

# The targets are in ascending order within each architecture.
TARGETS = (
    Target("x86-64-v2", "x86-64", ("-march=x86-64-v2",), _V2),
    Target("x86-64-v3", "x86-64", ("-march=x86-64-v3",), _V3),
    Target("x86-64-v4", "x86-64", ("-march=x86-64-v4",), _V4),
    Target("aarch64", "aarch64", ("-march=armv8-a",), processor.BASELINE["aarch64"]),
)


def native_target() -> Target:
    """All features of this processor. The library cannot be used on other models."""
    architecture = processor.architecture()
    option = "-march=native" if architecture == "x86-64" else "-mcpu=native"
    return Target("native", architecture, (option,))


def named(name: str) -> Target:
    """The target with this name.

    Raises:
        UserError: There is no such target.
    """
    known = {target.name: target for target in (*TARGETS, native_target())}
    if name not in known:
        raise UserError(
            f"unknown instruction-set target {name!r}; expected one of {', '.join(known)}",
            fix=f"correct or omit {VARIABLE} or --target",
        )
    return known[name]


def of_this_architecture() -> list[Target]:
    """The targets of this architecture, best first."""
    here = processor.architecture()
    return [target for target in reversed(TARGETS) if target.architecture == here]


def usable() -> list[Target]:
    """The targets that this processor can run, best first; only the one that ``SPLATMAKE_TARGET``
    names, if it is set.

    Raises:
        UserError: That target is unknown or not supported by the processor, or no target is.
    """
    if forced := os.environ.get(VARIABLE):
        target = named(forced)
        if target.missing:
            raise UserError(
                f"{VARIABLE}={forced}: this processor ({processor.processor_name()}) lacks "
                f"{', '.join(target.missing)}",
                fix=f"unset {VARIABLE} to use the processor's best target",
            )
        return [target]
    found = [target for target in of_this_architecture() if not target.missing]
    if not found:
        lacks = [target.missing for target in of_this_architecture()[-1:]]
        why = f"lacks {', '.join(lacks[0])}" if lacks else "is of an unsupported architecture"
        raise UserError(
            f"this processor ({processor.processor_name()}) {why}",
            fix=f"set {VARIABLE}=native, which is not tested, or use another machine",
        )
    return found


@dataclass(frozen=True)
class Extension:
    """A feature beyond those of a target, with the compiler flags for it."""

    feature: str
    flags: tuple[str, ...]


@dataclass(frozen=True)
class Variant:
    """A target with optional extensions, for which a library is compiled."""

    target: Target
    extensions: tuple[Extension, ...] = ()

    @property
    def name(self) -> str:
        return "+".join([self.target.name, *(e.feature for e in self.extensions)])

    @property
    def flags(self) -> list[str]:
        """Compiler flags; an extension's -march overrides the target's."""
        return [*self.target.flags, *(flag for e in self.extensions for flag in e.flags)]


Extensions = Mapping[str, Sequence[Extension]]


def usable_variants(extensions: Extensions) -> list[Variant]:
    """The variants that this processor can run, best first: for each usable target the one with
    all extensions that the processor has, then the one without.

    Args:
        extensions: The extensions that the library uses, by the target's name.
    """
    available = processor.features()
    found: list[Variant] = []
    for target in usable():
        more = tuple(e for e in extensions.get(target.name, ()) if e.feature in available)
        found += [Variant(target, more)] if more else []
        found.append(Variant(target))
    return found


def all_variants(target: Target, extensions: Extensions) -> list[Variant]:
    """The variants of a target for all processors that can run it."""
    more = tuple(extensions.get(target.name, ()))
    return [Variant(target), *([Variant(target, more)] if more else [])]
