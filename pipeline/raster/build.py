"""Compiles the kernels: ``python -m pipeline.raster.build``, or by itself at first use.

The library lands in ``build/raster/<key>/`` of the repository, or under $SPLATMAKE_CACHE, where
the key is a hash of all that decides its bits: sources, compiler, flags, torch, processor. It is
built in a folder beside and renamed, so that what exists is whole and two builds at once are
harmless. Importing this module imports no torch.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pipeline.runtime.errors import UserError

SOURCES = Path(__file__).parent / "csrc"
LIBRARY = "libsplatmake.so"
# -march=native: the vector width of this machine. No -ffast-math: it folds the rounding inside
# exp2 away. -ffp-contract=fast is GCC's default, said aloud: a * b + c is one rounding everywhere.
FLAGS = [
    *("-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math"),
    *("-ffp-contract=fast", "-fopenmp", "-fPIC", "-Wall", "-Wno-psabi", "-Wno-maybe-uninitialized"),
]
_lock = threading.Lock()
_loaded: Path | None = None


def source_files() -> list[Path]:
    """The kernels' sources and headers, sorted by name."""
    return sorted(p for p in SOURCES.iterdir() if p.suffix in (".cpp", ".h"))


def source_hash() -> str:
    """Hex digest of csrc: what a result depends on. Cheap, and needs neither torch nor compiler."""
    digest = hashlib.sha256()
    for path in source_files():
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def compiler() -> list[str]:
    """The C++ compiler's command, $CXX or g++. Raises UserError where there is none."""
    command = os.environ.get("CXX", "g++").split()
    if not command or shutil.which(command[0]) is None:
        name = command[0] if command else "$CXX"
        raise UserError(
            f"no C++ compiler found ({name})",
            fix="install g++ (e.g. apt-get install g++) or set CXX",
        )
    return command


def _processor() -> str:
    """Model and instruction sets of this processor."""
    lines = [platform.machine(), platform.processor()]
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            for line in file:
                if not line.strip():
                    break  # one core speaks for all
                if line.startswith(("model name", "flags", "Features", "CPU part")):
                    lines.append(line.strip())
    except OSError:
        pass
    return "\n".join(lines)


def _torch_root() -> Path:
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        raise UserError("torch is not installed", fix="pip install -e . in this environment")
    return Path(spec.origin).parent


def cache_root() -> Path:
    """Where libraries are kept: $SPLATMAKE_CACHE or <repository>/build/raster."""
    chosen = os.environ.get("SPLATMAKE_CACHE")
    return Path(chosen) if chosen else Path(__file__).parents[2] / "build" / "raster"


def build_key() -> str:
    """Names a library by everything that decides its bits."""
    command = compiler()
    version = subprocess.run([*command, "--version"], capture_output=True, text=True).stdout
    parts = [
        source_hash(),
        " ".join(command),
        version,
        " ".join(FLAGS),
        importlib.metadata.version("torch"),
        _processor(),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if "error" in line] or [done.stderr]
        raise UserError(
            f"compiling the rasterizer failed: {errors[0].strip()[:500]}",
            fix=f"run this to see all of it: {' '.join(command)}",
        )


def build() -> Path:
    """The library for this machine, compiled if it is not there yet.

    Raises:
        UserError: no compiler, or it fails.
    """
    library = cache_root() / build_key() / LIBRARY
    if library.exists():
        return library
    torch_root, command = _torch_root(), compiler()
    library.parent.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=".building-", dir=library.parent.parent))
    try:
        sources = [p for p in source_files() if p.suffix == ".cpp"]
        objects = [str(work / f"{p.stem}.o") for p in sources]
        include = ["-isystem", str(torch_root / "include")]

        def compile_one(source: Path, target: str) -> None:
            _run([*command, *FLAGS, *include, "-c", str(source), "-o", target])

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            list(pool.map(compile_one, sources, objects))
        libraries = [f"-L{torch_root / 'lib'}", "-ltorch_cpu", "-ltorch", "-lc10"]
        _run([*command, *FLAGS, "-shared", *objects, *libraries, "-o", str(work / LIBRARY)])
        for path in objects:
            os.unlink(path)
        try:
            os.rename(work, library.parent)
        except OSError:
            if not library.exists():  # otherwise another build was first: theirs is as good
                raise
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return library


def load() -> None:
    """Makes torch.ops.splatmake available in this process, building it where it is missing."""
    global _loaded
    if _loaded is not None:
        return
    with _lock:
        if _loaded is None:
            import torch

            library = build()
            torch.ops.load_library(str(library))
            _loaded = library


if __name__ == "__main__":
    print(build())
