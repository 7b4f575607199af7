"""What the machine can do at most: the calibration loops of peak.cpp."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from pipeline.raster import build

# Of 16 lanes, of which a multiply-add does two each: so many operations count as one vector
# operation. A machine that starts more of them when not all multiply is underrated.
VECTOR_FLOPS = 32


@dataclass(frozen=True)
class Peak:
    """Of ``threads`` threads: float32 operations and bytes moved, a second."""

    threads: int
    flops: float
    bytes: float


class Calibration:
    """The loops, compiled with the kernels' flags."""

    def __init__(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder) / "peak.so"
            source = Path(__file__).with_name("peak.cpp")
            flags = [*build.flags(), "-fopenmp", "-I", str(build.SOURCES), "-shared"]
            subprocess.run([*build.compiler(), *flags, str(source), "-o", str(library)], check=True)
            self._loaded = ctypes.CDLL(str(library))
        for function in (self._loaded.peak_flops, self._loaded.peak_bytes):
            function.restype = ctypes.c_double

    def flops(self, threads: int) -> float:
        """A second. Takes about 10 ms, so that it can stand before every step that is timed: a
        virtual machine's cores change their speed within seconds."""
        return self._loaded.peak_flops(threads)

    def peak(self, threads: int) -> Peak:
        return Peak(threads, self.flops(threads), self._loaded.peak_bytes(threads))
