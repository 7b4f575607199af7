"""What tests need beside the product's own packages, and what happens where it is missing.

A test is skipped where a program, a package or a file is missing. With SPLATMAKE_REQUIRE_ALL set,
as in CI, tests/conftest.py fails it instead, unless no package can help (``unsupported``).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NoReturn

import pytest

#: Real photographs, which lie beside the repository on some machines.
SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

PACKAGES = {
    "g++": "g++",
    "clang++": "clang",
    "aarch64-linux-gnu-g++": "g++-aarch64-linux-gnu",
    "aarch64-linux-gnu-objdump": "binutils-aarch64-linux-gnu",
    "node": "nodejs",
    "objdump": "binutils",
    "qemu-aarch64": "qemu-user",
    "munged": "munge",
    "setpriv": "util-linux",
    **dict.fromkeys(("slurmctld", "slurmd", "sbatch", "squeue", "scontrol"), "slurm-wlm"),
}
UNSUPPORTED = "not on this machine: "


def need(*programs: str) -> None:
    """Skips the test where one is missing."""
    path = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
    lacking = [program for program in programs if shutil.which(program, path=path) is None]
    if lacking:
        packages = " ".join(dict.fromkeys(PACKAGES.get(program, program) for program in lacking))
        pytest.skip(f"not run: {', '.join(lacking)} missing (apt-get install {packages})")


def need_sanitizers(compiler: Sequence[str], kinds: str) -> None:
    """Skips the test where the compiler's runtime for ``-fsanitize=kinds`` is not installed."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*compiler, f"-fsanitize={kinds}", "-x", "c++", "-", "-o", f"{folder}/program"]
        done = subprocess.run(command, input="int main() {}", text=True, capture_output=True)
    if done.returncode != 0:
        pytest.skip(
            f"not run: {compiler[0]} cannot link -fsanitize={kinds} "
            "(for clang++, apt-get install libclang-rt-dev)"
        )


def need_package(name: str, exactly: str | None = None) -> None:
    """Skips the test where a Python package, or this version of it, is not installed."""
    try:
        found = version(name)
    except PackageNotFoundError:
        found = "missing"
    if found == "missing" or exactly not in (None, found):
        wanted = name if exactly is None else f"{name}=={exactly}"
        pytest.skip(f"not run: {name} {found} (pip install {wanted})")


def need_gpu() -> None:
    """Skips the test without a device of WebGPU; one in software is enough."""
    need_package("wgpu")
    from pipeline.render.gpu.device import adapters

    if not adapters():
        pytest.skip("not run: no Vulkan device (apt-get install mesa-vulkan-drivers)")


def need_data(name: str) -> Path:
    """A file or folder of the shared data; skips the test where it is missing."""
    path = SHARED_DATA / name
    if not path.exists():
        unsupported(f"{path} is missing")
    return path


def unsupported(reason: str) -> NoReturn:
    """Skips a test that this processor, this system or this machine's data does not allow."""
    pytest.skip(UNSUPPORTED + reason)


def fail_skipped(
    report: pytest.TestReport | pytest.CollectReport,
) -> pytest.TestReport | pytest.CollectReport:
    """The report, failed if SPLATMAKE_REQUIRE_ALL is set and the test was skipped for want of
    something that can be installed."""
    if (
        os.environ.get("SPLATMAKE_REQUIRE_ALL")
        and report.skipped
        and not hasattr(report, "wasxfail")
    ):
        # pytest's form of a skip: file, line, "Skipped: reason".
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not reason.removeprefix("Skipped: ").startswith(UNSUPPORTED):
            report.outcome = "failed"
            report.longrepr = f"SPLATMAKE_REQUIRE_ALL is set, and this test did not run: {reason}"
    return report
