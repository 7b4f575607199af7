"""The processor: its name, its architecture and the instruction sets that it offers to programs.

Features have Linux's names (the flags of /proc/cpuinfo) on every system. Linux and macOS leave out
what the operating system does not support, so a feature in the list can be used.
"""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
ARCHITECTURES = {"x86_64": "x86-64", "amd64": "x86-64", "aarch64": "aarch64", "arm64": "aarch64"}

# Every x86-64 processor since 2009 has the first, every 64-bit Arm processor the second.
BASELINE = {
    "x86-64": frozenset({"cx16", "lahf_lm", "popcnt", "pni", "ssse3", "sse4_1", "sse4_2"}),
    "aarch64": frozenset({"asimd"}),
}

# macOS's names where they differ from Linux's by more than case and dots.
_DARWIN = {
    "sse3": "pni",
    "avx1_0": "avx",
    "lahf": "lahf_lm",
    "lzcnt": "abm",
    "avx512vnni": "avx512_vnni",
    "hw_optional_arm_feat_dotprod": "asimddp",
    "hw_optional_arm_feat_i8mm": "i8mm",
}
_DARWIN_X86 = [f"machdep.cpu.{part}" for part in ("features", "leaf7_features", "extfeatures")]


def architecture() -> str:
    """``x86-64``, ``aarch64``, or what the system calls another one."""
    name = platform.machine()
    return ARCHITECTURES.get(name.lower(), name)


def features() -> frozenset[str]:
    """Instruction-set features that a program may use; the architecture's baseline where the
    system does not say."""
    found: frozenset[str] = frozenset()
    if sys.platform == "darwin":
        found = darwin_features(
            [sysctl_value(name) for name in _DARWIN_X86], sysctl("hw.optional.arm")
        )
    elif CPUINFO.exists():
        found = linux_features(_first_core())
    baseline = BASELINE.get(architecture(), frozenset())
    # An Arm system that names no features at all (an emulator) still has the baseline.
    return found | baseline if architecture() == "aarch64" or not found else found


def linux_features(lines: Iterable[str]) -> frozenset[str]:
    """The features in one core's lines of /proc/cpuinfo."""
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() in ("flags", "Features"):
            return frozenset(value.split())
    return frozenset()


def darwin_features(intel: Iterable[str], arm: str) -> frozenset[str]:
    """The features in sysctl's answers, under Linux's names.

    Args:
        intel: values of machdep.cpu.features, leaf7_features and extfeatures, maybe empty.
        arm: all of hw.optional.arm, a ``name: value`` a line, maybe empty.
    """
    names = " ".join(intel).split()
    for line in arm.splitlines():
        name, _, value = line.partition(":")
        if value.strip() == "1":
            names.append(name)
    plain = (name.lower().replace(".", "_") for name in names)
    return frozenset(_DARWIN.get(name, name) for name in plain)


def processor() -> list[str]:
    """What the system says of its first core: model and instruction sets, a line each."""
    kept = ("model name", "flags", "Features", "CPU part")
    lines = [line for line in _first_core() if line.startswith(kept)]
    if not lines:
        lines = [processor_name(), " ".join(sorted(features()))]
    return [platform.machine(), platform.processor(), *lines]


def processor_name() -> str:
    """The model's name, else the architecture's."""
    for line in _first_core():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    if sys.platform == "darwin" and (brand := sysctl_value("machdep.cpu.brand_string")):
        return brand
    return platform.machine()


def sysctl(name: str) -> str:
    """macOS's answer, ``name: value`` a line; empty where it does not know the name."""
    try:
        done = subprocess.run(["/usr/sbin/sysctl", name], capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def sysctl_value(name: str) -> str:
    """The value alone, of a name that has one."""
    return sysctl(name).partition(":")[2].strip()


def _first_core() -> list[str]:
    """Its lines of /proc/cpuinfo: one core speaks for all. Empty where there is no such file."""
    lines: list[str] = []
    try:
        with open(CPUINFO, encoding="utf-8") as file:
            for line in file:
                if not line.strip():
                    break
                lines.append(line.strip())
    except OSError:
        pass
    return lines
