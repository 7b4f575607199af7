"""Compiles the kernels: ``python -m pipeline.raster.build``, or by itself at first use.

Importing this module imports no torch.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import threading
from pathlib import Path

from pipeline.runtime import native
from pipeline.runtime.errors import UserError
from pipeline.runtime.native import compiler

__all__ = ["build", "build_key", "compiler", "load", "source_files", "source_hash"]

SOURCES = Path(__file__).parent / "csrc"
# -march=native: the vector width of this machine. No -ffast-math: it folds the rounding inside
# exp2 away. -ffp-contract=fast is GCC's default, said aloud: a * b + c is one rounding everywhere.
FLAGS = [
    *("-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math"),
    *("-ffp-contract=fast", "-pthread", "-fPIC", "-Wall", "-Wno-psabi", "-Wno-maybe-uninitialized"),
]
_lock = threading.Lock()
_loaded: Path | None = None


def _library(
    compile_only: tuple[str, ...] = (), link_only: tuple[str, ...] = ()
) -> native.NativeLibrary:
    return native.NativeLibrary(
        name="rasterizer",
        file="libsplatmake.so",
        sources=SOURCES,
        flags=FLAGS,
        compile_only=compile_only,
        link_only=link_only,
        facts=[importlib.metadata.version("torch")],
    )


def source_files() -> list[Path]:
    """The kernels' sources and headers, sorted by name."""
    return _library().source_files()


def source_hash() -> str:
    """Hex digest of csrc: what a result depends on. Cheap, and needs neither torch nor compiler."""
    return _library().source_hash()


def build_key() -> str:
    """Names a library by everything that decides its bits."""
    return _library().key()


def _torch_root() -> Path:
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        raise UserError("torch is not installed", fix="pip install -e . in this environment")
    return Path(spec.origin).parent


def build() -> Path:
    """The library for this machine, compiled if it is not there yet.

    Raises:
        UserError: no compiler, or it fails.
    """
    torch_root = _torch_root()
    return _library(
        ("-isystem", str(torch_root / "include")),
        (f"-L{torch_root / 'lib'}", "-ltorch_cpu", "-ltorch", "-lc10"),
    ).build()


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
