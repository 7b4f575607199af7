"""Peak rates of the machine, measured by the calibration loops of peak.cpp."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from pipeline.render.cpu import build

# peak.cpp selects its instruction sets itself, independent of target and flags of the kernels.
FLAGS = ["-std=c++17", "-O3", "-ffp-contract=off", "-fPIC", "-shared", "-pthread"]
STARTS = (1, 2, 4)  # multiply-add vector instructions per cycle of existing processors
TOLERANCE = 0.15


@dataclass(frozen=True)
class Peak:
    """The peak of ``threads`` threads: float32 operations and bytes moved per second.

    Attributes:
        instruction_set: The widest instruction set of the processor.
        lanes: The float32 lanes of its registers.
        fused: Whether a multiplication and an addition are one instruction.
        clock: The cycles per second of one core.
    """

    threads: int
    flops: float
    bytes: float
    instruction_set: str
    lanes: int
    fused: bool
    clock: float

    def instructions(self, flops: float) -> float:
        """The vector instructions per second at this rate of operations."""
        return flops / self.lanes / (2 if self.fused else 1)

    @property
    def per_cycle(self) -> float:
        """The vector instructions that one core starts per cycle."""
        return self.instructions(self.flops) / (self.threads * self.clock)

    @property
    def expected_per_cycle(self) -> int:
        """The nearest of ``STARTS``: the number of units of the processor."""
        return min(STARTS, key=lambda n: abs(self.per_cycle / n - 1))

    @property
    def plausible(self) -> bool:
        """Whether the rate is consistent with the clock and a whole number of units."""
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
    """The compiled loops."""

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
        """The operations per second. The loop takes about 10 ms, so that it can run before every
        timed step: the speed of virtual machines varies within seconds."""
        return self._loaded.peak_flops(threads)

    def peak(self, threads: int) -> Peak:
        """The maximum of several readings, because other load only reduces it."""
        return Peak(
            threads,
            max(self.flops(threads) for _ in range(5)),
            max(self._loaded.peak_bytes(threads) for _ in range(2)),
            self._loaded.peak_name().decode(),
            self._loaded.peak_lanes(),
            bool(self._loaded.peak_fused()),
            max(self._loaded.peak_clock() for _ in range(5)),
        )
