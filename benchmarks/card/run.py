"""Runs the parts of ``python -m benchmarks.card`` and writes the record after each."""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.card import plan
from benchmarks.card.parts import Case
from benchmarks.card.plan import Part
from benchmarks.card.result import CardResult, Status, table
from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.raster.scenes import size_of
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.runtime.isolate import Limits, OverLimitError, run_limited
from pipeline.runtime.machine import usable_cores

SIZES = [(960, 540), (1600, 1067), (1920, 1080)]
COMPILE_S = 300.0  # The time limit of compiling gsplat, from its start.
NO_TIME = "the time of the whole measurement was over"


class Gsplat:
    """The installation of gsplat, which nvcc compiles while other parts are measured.

    Attributes:
        reason: Why it cannot be compiled here; empty if it can.
    """

    def __init__(self, sources: Path, built: Path):
        self.reason = self._why_not(sources)
        self._process: subprocess.Popen[bytes] | None = None
        self._log = built.with_suffix(".log")
        if self.reason:
            return
        built.parent.mkdir(parents=True, exist_ok=True)
        (file,) = sources.glob("gsplat-*.tar.gz")
        pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation"]
        command = [*pip, "--no-index", "--target", str(built), str(file)]
        environment = dict(os.environ, MAX_JOBS=str(max(1, usable_cores() // 2)))
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                ["nice", "-n", "10", *command], env=environment, stdout=log, stderr=log
            )
        self._end = time.monotonic() + COMPILE_S

    @staticmethod
    def _why_not(sources: Path) -> str:
        import torch

        if not torch.cuda.is_available() or shutil.which("nvcc") is None:
            return "no CUDA"
        return "" if [*sources.glob("gsplat-*.tar.gz")] else "its sources are not in the pack"

    def wait(self, deadline: float) -> str:
        """Wait for the compiler; returns why there is no gsplat, or an empty string."""
        if self._process is None:
            return self.reason
        try:
            code = self._process.wait(max(0.0, min(self._end, deadline) - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.end()
            self.reason = "compiling took too long"
        else:
            last = self._log.read_text(errors="replace").strip().splitlines()[-1:]
            self.reason = f"compiling failed: {' '.join(last)}" if code else ""
        return self.reason

    def end(self) -> None:
        """End the compiler if it runs."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.wait()


def measure(part: Part, limit_s: float) -> CardResult:
    """Measure a part in a process of its own, which is ended after ``limit_s`` seconds."""
    start = time.monotonic()
    figures: dict[str, float] = {}
    facts: dict[str, str] = {}
    status: Status
    try:
        figures, facts = run_limited(Limits(seconds=limit_s), part.run, part.case)
        status, reason = "measured", ""
    except OverLimitError as error:
        status, reason = "over its time", str(error)
    except UserError as error:
        status, reason = ("not measured" if part.needs_gpu else "failed"), error.what
    except Exception as error:
        status, reason = "failed", str(error).strip().splitlines()[-1]
    wall = round(time.monotonic() - start, 2)
    return CardResult(part.name, part.label, status, reason, wall, figures, facts)


def _arguments(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.card", description=__doc__)
    parser.add_argument("pack", type=Path, help="folder of python -m benchmarks.card.pack")
    parser.add_argument("--device", default="gpu", help="gpu or gpu:N (default: gpu)")
    parser.add_argument("--counts", type=int, nargs="+", default=[50_000, 200_000, 1_000_000])
    parser.add_argument("--sizes", type=size_of, nargs="+", default=SIZES, metavar="WxH")
    parser.add_argument("--seconds", type=float, nargs="*", default=[20, 60], help="of training")
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2, 4, 8, 16])
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--steps", type=int, default=300, help="of trainings by steps")
    parser.add_argument("--gaussians", type=int, default=200_000, help="at most in trainings")
    parser.add_argument("--minutes", type=float, default=8.5, help="of the whole measurement")
    add_record_options(parser)
    return parser.parse_args(arguments)


def main(arguments: Sequence[str]) -> int:
    options = _arguments(arguments)
    deadline = time.monotonic() + 60 * options.minutes
    if not (options.pack / "scene" / "point_cloud.spz").is_file():
        print(f"error: {options.pack}: expected a folder of benchmarks.card.pack", file=sys.stderr)
        return EXIT_USER_ERROR
    pack = options.pack.resolve()
    case = Case(
        scene=pack / "scene",
        sources=pack / "sources",
        built=pack / "installed" / "gsplat",
        device=options.device,
        count=options.counts[-1],
        size=options.sizes[-1],
        threads=usable_cores(),
        turns=options.turns,
        seconds=0.0,
        steps=options.steps,
        gaussians=options.gaussians,
    )
    threads = [n for n in options.threads if n <= usable_cores()]
    parts = plan.planned(case, options.counts, options.sizes, options.seconds, threads)
    gsplat = Gsplat(case.sources, case.built)
    found: list[CardResult] = []
    try:
        for part in parts:
            left = deadline - time.monotonic()
            reason = gsplat.wait(deadline) if part.name == "gsplat" else ""
            reason = reason or (NO_TIME if left < 5 else "")
            if reason:
                result = CardResult(part.name, part.label, "not measured", reason, 0.0)
            else:
                result = measure(part, min(part.limit_s, left))
            found.append(result)
            print(table([result]).splitlines()[-1], flush=True)
            if options.json:
                write_record(options.json, measured("card", options.note, arguments), found)
    finally:
        gsplat.end()
    return 0
