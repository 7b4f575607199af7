"""Compiles the kernels: ``python -m pipeline.render.cpu.build``, or by itself at first use.

``--target x86-64-v2 x86-64-v3`` compiles them for other processors than this one, beside each
other. Importing this module imports no torch.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import sys
import threading
from pathlib import Path

from pipeline.runtime import native, targets
from pipeline.runtime.errors import UserError
from pipeline.runtime.native import Built, compiler

__all__ = ["build", "compiler", "flags", "library", "load", "source_files", "source_hash"]

SOURCES = Path(__file__).parent / "csrc"
# No -ffast-math: it folds the rounding inside exp2 away. -ffp-contract=fast is GCC's default, said
# aloud: a * b + c is one rounding everywhere. The last flag keeps clang from remarking on warnings
# that only GCC has.
FLAGS = [
    *("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math"),
    *("-ffp-contract=fast", "-pthread", "-fPIC", "-Wall", "-Wno-psabi", "-Wno-maybe-uninitialized"),
    "-Wno-unknown-warning-option",
]
_lock = threading.Lock()
_loaded: Built | None = None


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
        # Without a local version (+cpu, +cu128): those builds share libtorch_cpu's interface.
        facts={"torch": importlib.metadata.version("torch").partition("+")[0]},
    )


def flags(target: str | None = None) -> list[str]:
    """The compiler's flags for a target; by default the one in use here."""
    chosen = targets.usable()[0] if target is None else targets.named(target)
    return [*chosen.flags, *FLAGS]


def source_files() -> list[Path]:
    """The kernels' sources and headers, sorted by name."""
    return sorted(p for p in SOURCES.iterdir() if p.suffix in (".cpp", ".h"))


def source_hash() -> str:
    """Hex digest of csrc: what a result depends on. Cheap, and needs neither torch nor compiler."""
    return _library().source_hash()


def _torch_root() -> Path:
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        raise UserError("torch is not installed", fix="pip install -e . in this environment")
    return Path(spec.origin).parent


def library() -> native.NativeLibrary:
    """The kernels as a library of torch's operators. Raises UserError where torch is missing."""
    torch_root = _torch_root()
    link = [f"-L{torch_root / 'lib'}", "-ltorch_cpu", "-ltorch", "-lc10"]
    if sys.platform == "darwin":  # Linux finds torch's libraries by the names of the loaded ones
        link.append(f"-Wl,-rpath,{torch_root / 'lib'}")
    return _library(("-isystem", str(torch_root / "include")), tuple(link))


def build() -> Built:
    """The library for this machine, compiled if it is not there yet.

    Raises:
        UserError: see ``NativeLibrary.build``.
    """
    return library().build()


def load() -> Built:
    """Makes torch.ops.splatmake available in this process, building it where it is missing."""
    global _loaded
    if _loaded is not None:
        return _loaded
    with _lock:
        if _loaded is None:
            import torch

            built = build()
            torch.ops.load_library(str(built.path))
            _loaded = built
    return _loaded


if __name__ == "__main__":
    sys.exit(native.build_main(library))
