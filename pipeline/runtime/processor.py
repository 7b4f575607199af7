"""The processor's name, architecture and instruction-set features.

Features have Linux's names (the flags of /proc/cpuinfo) on every system. Linux and macOS omit
features that the operating system does not support.
"""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
ARCHITECTURES = {"x86_64": "x86-64", "amd64": "x86-64", "aarch64": "aarch64", "arm64": "aarch64"}

# x86-64-v2 (all processors since 2009); all 64-bit Arm processors.
BASELINE = {
    "x86-64": frozenset({"cx16", "lahf_lm", "popcnt", "pni", "ssse3", "sse4_1", "sse4_2"}),
    "aarch64": frozenset({"asimd"}),
}

# macOS's names that differ from Linux's by more than case and dots.
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
    """``x86-64``, ``aarch64``, or the system's name of another architecture."""
    name = platform.machine()
    return ARCHITECTURES.get(name.lower(), name)


def features() -> frozenset[str]:
    """Instruction-set features that a program may use; the architecture's baseline if the system
    lists none."""
    found: frozenset[str] = frozenset()
    if sys.platform == "darwin":
        found = darwin_features(
            [sysctl_value(name) for name in _DARWIN_X86], sysctl("hw.optional.arm")
        )
    elif CPUINFO.exists():
        found = linux_features(_first_core())
    baseline = BASELINE.get(architecture(), frozenset())
    # Emulated Arm systems may list no features.
    return found | baseline if architecture() == "aarch64" or not found else found


def linux_features(lines: Iterable[str]) -> frozenset[str]:
    """The features in the lines of a core in /proc/cpuinfo."""
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() in ("flags", "Features"):
            return frozenset(value.split())
    return frozenset()


def darwin_features(intel: Iterable[str], arm: str) -> frozenset[str]:
    """The features in macOS's sysctl values, with Linux's names.

    Args:
        intel: The values of machdep.cpu.features, leaf7_features and extfeatures; may be empty.
        arm: The values below hw.optional.arm, one ``name: value`` per line; may be empty.
    """
    names = " ".join(intel).split()
    for line in arm.splitlines():
        name, _, value = line.partition(":")
        if value.strip() == "1":
            names.append(name)
    plain = (name.lower().replace(".", "_") for name in names)
    return frozenset(_DARWIN.get(name, name) for name in plain)


def processor() -> list[str]:
    """Lines that describe the first core: model and instruction sets."""
    kept = ("model name", "flags", "Features", "CPU part")
    lines = [line for line in _first_core() if line.startswith(kept)]
    if not lines:
        lines = [processor_name(), " ".join(sorted(features()))]
    return [platform.machine(), platform.processor(), *lines]


def processor_name() -> str:
    """The name of the model, else of the architecture."""
    for line in _first_core():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    if sys.platform == "darwin" and (brand := sysctl_value("machdep.cpu.brand_string")):
        return brand
    return platform.machine()


def sysctl(name: str) -> str:
    """The values of macOS's sysctl, one ``name: value`` per line; empty for unknown names."""
    try:
        done = subprocess.run(["/usr/sbin/sysctl", name], capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def sysctl_value(name: str) -> str:
    """A single value of macOS's sysctl, without its name."""
    return sysctl(name).partition(":")[2].strip()


def _first_core() -> list[str]:
    """The first core's lines of /proc/cpuinfo; empty if there is no such file."""
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
