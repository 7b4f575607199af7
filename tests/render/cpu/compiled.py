"""Kernels and the driver compiled outside torch, once for each compiler and flags."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pipeline.render.cpu import build
from tests.once import made_once

DRIVER = Path(__file__).with_name("driver.cpp")


def run(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stderr[-3000:]}"


def compiled(
    factory: pytest.TempPathFactory, compiler: Sequence[str], flags: Sequence[str]
) -> Path:
    """A folder with ``driver`` and the object file of each kernel."""
    sources = [p for p in build.source_files() if p.suffix == ".cpp" and p.stem != "binding"]
    # The driver is last: of duplicate functions the linker takes the first, which is the kernels'.
    sources.append(DRIVER)
    command = [*compiler, *flags, "-I", str(build.SOURCES)]

    def make(folder: Path) -> None:
        folder.mkdir()
        objects = [folder / f"{source.stem}.o" for source in sources]
        with ThreadPoolExecutor(2) as pool:
            jobs = []
            for source, target in zip(sources, objects, strict=True):
                # The driver need not be optimised.
                more = ["-O0"] if source == DRIVER else []
                step = [*command, *more, "-c", str(source), "-o", str(target)]
                jobs.append(pool.submit(run, step))
            for job in jobs:
                job.result()
        run([*command, *map(str, objects), "-o", str(folder / "driver")])

    key = hashlib.sha256("\0".join(command).encode()).hexdigest()[:12]
    return made_once(factory, f"kernels-{key}", make)
