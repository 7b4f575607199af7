"""The order of the parts and their time limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from benchmarks.card import parts
from benchmarks.card.parts import Case, Found


@dataclass(frozen=True)
class Part:
    """A part at one case, and the seconds after which its process is ended."""

    name: str
    label: str
    run: Callable[[Case], Found]
    case: Case
    limit_s: float
    needs_gpu: bool = True


#: The names of the parts.
PARTS = ("compile", "device", "step", "frames", "train", "bits", "gsplat", "processor")


def planned(
    case: Case,
    counts: list[int],
    sizes: list[tuple[int, int]],
    seconds: list[float],
    threads: list[int],
) -> list[Part]:
    """All parts, the most important first: what comes last is missed if the time ends."""
    found = [
        Part("compile", "", parts.compiled, case, 120, needs_gpu=False),
        Part("device", "", parts.device, case, 30),
        Part("frames", _size(case), parts.frames, case, 30),
    ]
    found += [
        Part("train", f"{s:g} s", parts.training, replace(case, seconds=s), 1.3 * s + 60)
        for s in seconds
    ]
    several = [replace(case, count=n, size=size) for n in counts for size in sizes]
    found += [
        Part("step", f"{each.count} Gaussians, {_size(each)}", parts.step, each, 60)
        for each in several
    ]
    found += [Part("bits", f"{case.steps} steps", parts.same_bits, case, 60)]
    found += [
        Part("gsplat", f"{each.count} Gaussians, {_size(each)}", parts.gsplat, each, 40)
        for each in several
    ]
    on_cpu = replace(case, device="cpu")
    return found + [
        Part("processor", f"{n} threads", parts.processor, replace(on_cpu, threads=n), 60, False)
        for n in threads
    ]


def _size(case: Case) -> str:
    return f"{case.size[0]}x{case.size[1]}"
