"""Runs the timing program of another rasterizer on our scenes, in alternation with ours.

The program is called as ``PROGRAM REPEATS FILE``. The file holds int32 width, height, N and N rows
of 10 float32: x, y, the inverse covariance's xx, xy, yy, opacity, red, green, blue, depth. Its last
line of output is a row of which the second cell, between bars, starts with the least milliseconds
of bin, forward and backward, each CPU time over threads.
"""

from __future__ import annotations

import os
import statistics
import struct
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.raster.measure import Step
from pipeline.runtime.errors import UserError

OPERATORS = ("bin", "blend", "blend backward")
REPEATS = 5


@dataclass(frozen=True)
class Versus:
    """The CPU milliseconds over threads by operator, medians over the turns."""

    ours: dict[str, float]
    theirs: dict[str, float]

    @property
    def ratio(self) -> float:
        return sum(self.ours[name] for name in OPERATORS) / sum(self.theirs.values())

    @property
    def step_ratio(self) -> float:
        """The ratio of our whole step to their three operators."""
        return self.ours["step"] / sum(self.theirs.values())


def write_scene(step: Step, path: Path) -> None:
    drawn = step.drawn.radii.numpy() > 0
    records = step.state.projected.records.numpy()[drawn]
    centres = records[:, :4].copy().view(np.float64)
    uu, uw, ww, log2_opacity = records[:, 4:8].T.astype(np.float64)
    scale = 2 / np.log2(np.e)  # records store the root of the inverse covariance times log2(e) / 2
    conic = np.stack([uu * uu, uu * uw, uw * uw + ww * ww], 1) * scale
    rows = np.column_stack(
        [centres, conic, np.exp2(log2_opacity), records[:, 8:11], records[:, 11]]
    )
    width, height = step.state.projected.size
    head = struct.pack("<3i", width, height, len(rows))
    path.write_bytes(head + rows.astype("<f4").tobytes())


def _their_times(program: Path, scene: Path, threads: int) -> list[float]:
    # Idle threads spin, as ours do.
    env = {**os.environ, "OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "active"}
    done = subprocess.run(
        [program, str(REPEATS), scene], env=env, capture_output=True, text=True, check=True
    )
    try:
        return [float(v) for v in done.stdout.splitlines()[-1].split("|")[1].split()[:3]]
    except (IndexError, ValueError):
        raise UserError(
            "the probe's output was not understood",
            file=program,
            fix="see benchmarks/raster/probe.py",
        ) from None


def versus(step: Step, program: Path, turns: int) -> Versus:
    """Measure theirs and ours ``turns`` times, the minimum of a few repeats each."""
    theirs: list[list[float]] = []
    ours: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.bin"
        write_scene(step, scene)
        for _ in range(turns):
            theirs.append(_their_times(program, scene, step.threads))
            steps = [step.once() for _ in range(REPEATS)]
            for name in (*OPERATORS, "step"):
                ours.setdefault(name, []).append(min(s[name].cpu for s in steps))
    medians = {name: statistics.median(values) for name, values in ours.items()}
    return Versus(
        medians,
        {name: statistics.median(t[i] for t in theirs) for i, name in enumerate(OPERATORS)},
    )
