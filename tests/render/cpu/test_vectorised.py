"""The kernels' inner loops are vector code for every target, whatever the compiler makes of the
vector type: a lowering to scalar code through memory costs a factor of four and changes no result.

An operation on 16 lanes that is lowered becomes 16 scalar instructions and as many moves of single
lanes, so the bounds are a few such operations in one innermost loop. What loops do for one Gaussian
or one row in scalar code stays below.
"""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path

import pytest

from pipeline.render.cpu import build
from pipeline.runtime import processor, targets
from pipeline.runtime.targets import TARGETS
from tests.render.cpu.compiled import compiled, compiled_library
from tests.render.cpu.disassembly import Loop, innermost_loops
from tests.tools import need, unsupported

KERNELS = {
    "blend": "splat::blend(",
    "blend_backward": "backward_tiles<",
    "loss": "l1_ssim(",
    "project": "project_view(",
    "project_backward": "project_view_backward(",
    "adam": "adam_",
}
"""Each kernel with a part of the names of its functions."""
X86 = platform.machine().lower() in ("x86_64", "amd64")
LANES = 16
MOST_SCALAR, MOST_SCALAR_SHARE = 4 * LANES, 0.15
MOST_MOVES, MOST_MOVES_SHARE = 6 * LANES, 0.2
LEAST_PACKED = 16  # in at least one loop of each kernel: otherwise no loop was recognised


def _tools(target: str) -> tuple[list[str], str]:
    """Compiler and objdump for a target; skips if this machine has none."""
    if (target == "aarch64") == X86:
        if not X86:
            unsupported("no cross compiler for x86-64 is looked for")
        compiler, objdump = ["aarch64-linux-gnu-g++", "-static"], "aarch64-linux-gnu-objdump"
    else:
        compiler, objdump = build.compiler(), "objdump"
    need(compiler[0], objdump)
    return compiler, objdump


def _fault(loop: Loop) -> str | None:
    counts = f"{loop.packed} packed, {loop.scalar} scalar, {loop.lane_moves} moves of a lane"
    where = f"in an inner loop of {loop.function[:160]}: {counts}"
    if loop.scalar >= MOST_SCALAR and loop.scalar > MOST_SCALAR_SHARE * loop.arithmetic:
        return f"scalar arithmetic {where}"
    if loop.lane_moves >= MOST_MOVES and loop.lane_moves > MOST_MOVES_SHARE * loop.arithmetic:
        return f"vectors taken apart {where}"
    return None


@pytest.mark.parametrize("target", [target.name for target in TARGETS])
def test_inner_loops_are_vector_code(target: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    compiler, objdump = _tools(target)
    if targets.named(target).architecture == processor.architecture():
        files = [compiled_library(tmp_path_factory, target)]
    else:
        folder = compiled(tmp_path_factory, compiler, build.flags(target))
        files = [path for path in folder.glob("*.o") if path.stem != "driver"]
    loops = [loop for path in files for loop in innermost_loops(objdump, path)]
    faults = list(dict.fromkeys(filter(None, map(_fault, loops))))
    assert not faults, f"{len(faults)} inner loops, the first: {faults[0]}"
    for kernel, name in KERNELS.items():
        assert max((loop.packed for loop in loops if name in loop.function), default=0) >= (
            LEAST_PACKED
        ), f"{kernel}: no inner loop with vector arithmetic found"


def test_scalar_code_is_detected(tmp_path: Path) -> None:
    """The check fails for a loop that the compiler must not vectorise."""
    compiler, objdump = _tools("x86-64-v3" if X86 else "aarch64")
    source = tmp_path / "scalar.cpp"
    statements = "".join(f"s[{i}] = s[{i}] * a[{i}] + 1.5f;" for i in range(80))
    source.write_text(
        f"void f(float* s, const float* a, int n) {{ while (n--) {{ {statements} }} }}"
    )
    out = tmp_path / "scalar.o"
    off = ["-O2", "-fno-tree-vectorize", "-fno-tree-slp-vectorize"]
    subprocess.run([*compiler, *off, "-c", str(source), "-o", str(out)], check=True)
    assert any(_fault(loop) for loop in innermost_loops(objdump, out))
