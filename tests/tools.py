"""Compilers and other programs that tests use where they are installed."""

from __future__ import annotations

import os
import shutil

import pytest

PACKAGES = {
    "g++": "g++",
    "clang++": "clang",
    "aarch64-linux-gnu-g++": "g++-aarch64-linux-gnu",
    "aarch64-linux-gnu-objdump": "binutils-aarch64-linux-gnu",
    "objdump": "binutils",
    "qemu-aarch64": "qemu-user",
}


def need(*programs: str) -> None:
    """Skips the test where one is missing; with SPLATMAKE_REQUIRE_COMPILERS, as in CI, fails it."""
    lacking = [program for program in programs if shutil.which(program) is None]
    if not lacking:
        return
    packages = " ".join(PACKAGES.get(program, program) for program in lacking)
    text = f"not run: {', '.join(lacking)} missing (apt-get install {packages})"
    if os.environ.get("SPLATMAKE_REQUIRE_COMPILERS"):
        pytest.fail(text)
    pytest.skip(text)
