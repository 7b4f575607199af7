"""Compile the kernels: ``python -m pipeline.render.cpu.build``, or automatically at first use.

``--target x86-64-v2 x86-64-v3`` compiles them for other processors. Importing this module does not
import torch.
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
# No -ffast-math: it removes the rounding step of exp2. -ffp-contract=fast is GCC's default; with it
# clang rounds a * b + c once, too. The last flag silences clang about options of GCC.
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
        # Without the local version (+cpu, +cu128): these builds have the same libtorch_cpu ABI.
        facts={"torch": importlib.metadata.version("torch").partition("+")[0]},
    )


def flags(target: str | None = None) -> list[str]:
    """The compiler's flags for a target, by default the best one for this machine."""
    chosen = targets.usable()[0] if target is None else targets.named(target)
    return [*chosen.flags, *FLAGS]


def source_files() -> list[Path]:
    """The kernels' sources and headers, sorted by name."""
    return sorted(p for p in SOURCES.iterdir() if p.suffix in (".cpp", ".h"))


def source_hash() -> str:
    """Hex digest of the sources in csrc. Needs neither torch nor a compiler."""
    return _library().source_hash()


def _torch_root() -> Path:
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        raise UserError("torch is not installed", fix="install splatmake with its dependencies")
    return Path(spec.origin).parent


def library() -> native.NativeLibrary:
    """The kernels as a library of torch operators.

    Raises:
        UserError: torch is not installed.
    """
    torch_root = _torch_root()
    link = [f"-L{torch_root / 'lib'}", "-ltorch_cpu", "-ltorch", "-lc10"]
    if sys.platform == "darwin":  # Linux uses the libraries that torch has loaded.
        link.append(f"-Wl,-rpath,{torch_root / 'lib'}")
    return _library(("-isystem", str(torch_root / "include")), tuple(link))


def build() -> Built:
    """The library for this machine, compiled if necessary.

    Raises:
        UserError: see ``NativeLibrary.build``.
    """
    return library().build()


def load() -> Built:
    """Load torch.ops.splatmake into this process; compiles the library if necessary."""
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
