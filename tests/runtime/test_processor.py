"""Instruction-set features as Linux and macOS name them."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from pipeline.runtime import machine, processor
from pipeline.runtime.targets import named

# Shortened; one core's lines, then the next core's.
ZEN3 = """processor\t: 0
model name\t: AMD Ryzen 5 5600X
flags\t\t: cx16 lahf_lm popcnt pni ssse3 sse4_1 sse4_2 avx avx2 bmi1 bmi2 f16c fma abm movbe

processor\t: 1
flags\t\t: avx512f
"""
GRAVITON = "processor\t: 0\nFeatures\t: fp asimd evtstrm aes asimdhp asimddp\nCPU part\t: 0xd0c\n"
INTEL_MAC = [
    "FPU SSE SSE2 SSE3 SSSE3 FMA CX16 SSE4.1 SSE4.2 MOVBE POPCNT AVX1.0 F16C",
    "BMI1 AVX2 BMI2 ERMS AVX512F AVX512CD",
    "SYSCALL LAHF LZCNT RDTSCP",
]
APPLE_SILICON = """hw.optional.arm.FEAT_DotProd: 1
hw.optional.arm.FEAT_I8MM: 0
hw.optional.arm.caps: 868062207
"""


def on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arch: str, cpuinfo: str) -> None:
    """Let this be a Linux machine with that processor."""
    (tmp_path / "cpuinfo").write_text(cpuinfo)
    monkeypatch.setattr(processor, "CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(processor.sys, "platform", "linux")
    monkeypatch.setattr(platform, "machine", lambda: arch)


def test_linux_names_the_features_of_the_first_core(tmp_path, monkeypatch):
    on(monkeypatch, tmp_path, "x86_64", ZEN3)
    assert processor.architecture() == "x86-64"
    assert processor.processor_name() == "AMD Ryzen 5 5600X"
    assert not named("x86-64-v3").missing
    assert "avx512f" in named("x86-64-v4").missing
    on(monkeypatch, tmp_path, "aarch64", GRAVITON)
    assert processor.architecture() == "aarch64"
    assert {"asimd", "asimddp"} <= processor.features()
    assert processor.processor_name() == "aarch64"


def test_what_a_system_hides_is_not_used(tmp_path, monkeypatch):
    """An operating system without AVX's registers takes their flags away."""
    on(monkeypatch, tmp_path, "x86_64", ZEN3.replace(" avx avx2 ", " "))
    assert named("x86-64-v3").missing == ["avx", "avx2"]
    assert not named("x86-64-v2").missing


def test_intel_macs_name_features_in_their_own_way():
    found = processor.darwin_features(INTEL_MAC, "")
    assert named("x86-64-v3").features <= found
    assert {"avx512f", "avx512cd"} <= found and "avx512bw" not in found


def test_apple_silicon_has_the_dot_product(monkeypatch):
    found = processor.darwin_features(["", "", ""], APPLE_SILICON)
    assert "asimddp" in found and "i8mm" not in found
    monkeypatch.setattr(processor.sys, "platform", "darwin")
    monkeypatch.setattr(platform, "machine", lambda: "arm64")
    monkeypatch.setattr(
        processor, "sysctl", lambda name: APPLE_SILICON if name == "hw.optional.arm" else ""
    )
    assert {"asimd", "asimddp"} <= processor.features()


@pytest.mark.parametrize(("arch", "feature"), [("AMD64", "sse4_2"), ("arm64", "asimd")])
def test_a_system_that_says_nothing_has_the_baseline(tmp_path, monkeypatch, arch, feature):
    on(monkeypatch, tmp_path, arch, "")
    (tmp_path / "cpuinfo").unlink()
    assert feature in processor.features()
    assert processor.features() == processor.BASELINE[processor.architecture()]


def test_cores_are_those_that_may_be_used(monkeypatch, tmp_path):
    monkeypatch.setattr(machine.os, "sched_getaffinity", lambda _: {0, 3, 5}, raising=False)
    assert machine.usable_cores(tmp_path) == 3
    # Two of them are threads of one core.
    for cpu, siblings in ((0, "0,3"), (3, "0,3"), (5, "2,5")):
        topology = tmp_path / f"sys/devices/system/cpu/cpu{cpu}/topology"
        topology.mkdir(parents=True)
        (topology / "thread_siblings_list").write_text(siblings + "\n")
    assert machine.usable_cores(tmp_path) == 2
    monkeypatch.delattr(machine.os, "sched_getaffinity")
    monkeypatch.setattr(machine.os, "cpu_count", lambda: 7)
    assert machine.usable_cores() == 7
