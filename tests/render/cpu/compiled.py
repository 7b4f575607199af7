"""The product's library of kernels for each target, and the driver of the kernels, made once."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pipeline.render.cpu import build
from pipeline.runtime import native
from tests.once import made_once

DRIVER = Path(__file__).with_name("driver.cpp")


def run(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stderr[-3000:]}"


def compiled_library(factory: pytest.TempPathFactory, target: str) -> Path:
    """The product's library for a target of this architecture, compiled if it does not exist."""

    def make(folder: Path) -> None:
        folder.symlink_to(native.build_targets(build.library(), [target])[0].path.parent)

    return made_once(factory, f"library-{target}", make).resolve() / build.library().file


def linked_driver(factory: pytest.TempPathFactory, target: str) -> Path:
    """The driver, which calls the kernels of the product's library for a target."""
    library = compiled_library(factory, target)
    # Hidden: the library calls its own copies of inline functions, which are optimised.
    flags = [*build.flags(target), "-O0", "-fvisibility=hidden", "-I", str(build.SOURCES)]
    torch = build.library().link_only
    paths = [str(library.parent), *(flag[2:] for flag in torch if flag.startswith("-L"))]
    # The path of torch's libraries is the driver's RPATH, which holds for its libraries, too.
    link = [*torch, "-Wl,--disable-new-dtags", *(f"-Wl,-rpath,{path}" for path in paths)]

    def make(folder: Path) -> None:
        folder.mkdir()
        files = [str(DRIVER), str(library), "-o", str(folder / "driver")]
        run([*build.compiler(), *flags, *files, *link])

    return made_once(factory, f"driver-{target}", make) / "driver"


def compiled(
    factory: pytest.TempPathFactory, compiler: Sequence[str], flags: Sequence[str]
) -> Path:
    """A folder with ``driver`` and the object file of each kernel, compiled without torch."""
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
