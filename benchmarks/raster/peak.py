"""What the machine can do at most: the calibration loops of peak.cpp."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from pipeline.render.cpu import build

# peak.cpp names its instruction sets itself: neither the target nor the kernels' flags matter.
FLAGS = ["-std=c++17", "-O3", "-ffp-contract=off", "-fPIC", "-shared", "-pthread"]
STARTS = (1, 2, 4)  # vector instructions that multiply and add a cycle, of any processor so far
TOLERANCE = 0.15


@dataclass(frozen=True)
class Peak:
    """Of ``threads`` threads: float32 operations and bytes moved, a second.

    Attributes:
        instruction_set: the widest that the processor has.
        lanes: of its registers, float32.
        fused: whether a multiplication and an addition are one instruction.
        clock: cycles a second of one core.
    """

    threads: int
    flops: float
    bytes: float
    instruction_set: str
    lanes: int
    fused: bool
    clock: float

    def instructions(self, flops: float) -> float:
        """Vector instructions a second at this rate of operations."""
        return flops / self.lanes / (2 if self.fused else 1)

    @property
    def per_cycle(self) -> float:
        """Vector instructions that one core starts in a cycle."""
        return self.instructions(self.flops) / (self.threads * self.clock)

    @property
    def expected_per_cycle(self) -> int:
        """What the processor has units for: the nearest of ``STARTS``."""
        return min(STARTS, key=lambda n: abs(self.per_cycle / n - 1))

    @property
    def plausible(self) -> bool:
        """Whether the rate is what the clock and a whole number of units allow."""
        return abs(self.per_cycle / self.expected_per_cycle - 1) <= TOLERANCE

    def __str__(self) -> str:
        kind = "multiply-adds" if self.fused else "multiplications and additions"
        text = (
            f"{self.threads} threads: peak {self.flops / 1e9:.0f} GFLOP/s by {self.instruction_set}"
            f" {kind}, {self.per_cycle:.2f} a cycle at {self.clock / 1e9:.2f} GHz "
            f"({self.per_cycle / self.expected_per_cycle:.2f} of {self.expected_per_cycle}), "
            f"{self.bytes / 1e9:.1f} GB/s"
        )
        if not self.plausible:
            text += (
                f"\nwarning: not within {TOLERANCE:.0%} of a whole number a cycle: other programs "
                "run, cores are shared or the clock changes; fractions of the peak are unreliable"
            )
        return text


class Calibration:
    """The loops, compiled."""

    def __init__(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder) / "peak.so"
            source = Path(__file__).with_name("peak.cpp")
            command = [*build.compiler(), *FLAGS, str(source), "-o", str(library)]
            subprocess.run(command, check=True)
            self._loaded = ctypes.CDLL(str(library))
        for function in ("peak_flops", "peak_bytes", "peak_clock"):
            getattr(self._loaded, function).restype = ctypes.c_double
        self._loaded.peak_name.restype = ctypes.c_char_p

    def flops(self, threads: int) -> float:
        """A second. Takes about 10 ms, so that it can stand before every step that is timed: a
        virtual machine's cores change their speed within seconds."""
        return self._loaded.peak_flops(threads)

    def peak(self, threads: int) -> Peak:
        """The best of some readings, because other programs only make it smaller."""
        return Peak(
            threads,
            max(self.flops(threads) for _ in range(5)),
            max(self._loaded.peak_bytes(threads) for _ in range(2)),
            self._loaded.peak_name().decode(),
            self._loaded.peak_lanes(),
            bool(self._loaded.peak_fused()),
            max(self._loaded.peak_clock() for _ in range(5)),
        )
