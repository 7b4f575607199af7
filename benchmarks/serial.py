"""The serial part of training steps on a CPU, by phase: Amdahl's law from 1 and several threads.

    python -m benchmarks.serial --gaussians 200000 --size 640 400 --json FILE

Trains a synthetic scene from the middle of the schedule, with density control, by two trainers in
turns: one on one thread, the other on ``--threads``. Both compute the same bits, so that each turn
is the same work, and so is each repeat of the whole measurement. Times are medians over the repeats
of a turn in which other programs took less than 4 % of one core, or the repeat in which they took
least. Kernels are timed one by one. The rest of a step, in Python and torch, runs on one thread.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.memory import made_gaussians, made_views
from benchmarks.raster.peak import Calibration
from benchmarks.record_tables import forecast_table, serial_table
from benchmarks.results import STEP, SerialResult
from pipeline.config.density import Gradient
from pipeline.config.settled import TrainOptions
from pipeline.render import make_backend
from pipeline.render.cpu import backend as cpu
from pipeline.scene.exposure import ViewLight
from pipeline.scene.views import View, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.setup import initial_state, load_scene
from pipeline.training.loop.train import single_torch_thread
from pipeline.training.loop.trainer import Trainer
from pipeline.training.run import TrainingRun

VIEWS = 48
TURN = 10  # steps; the steps between two densifications are a multiple
KERNELS = {
    "project": "projection, SH",
    "bin": "bin",
    "blend": "blend",
    "l1_ssim": "loss",
    "blend_backward": "blend backward",
    "project_backward": "projection, SH backward",
    "frame_adam": "Adam",
    "adam_step": "Adam",
    "observe_gradients": "density statistics",
    "scale_colors": "light",
    "mean_squared_error": "PSNR",
}
CONTROL, REST = "density control", "other Python and torch"
ORDER = (*dict.fromkeys(KERNELS.values()), CONTROL, REST)
Seconds = dict[str, float]
# The time that other programs ran in a turn, over its wall time. Turns below the limit are quiet.
OTHERS, QUIET = "other programs", 0.04
SAMPLE = 0.5  # seconds for which other programs are watched before a turn


class Phases:
    """Adds up the seconds of phases, each without the phases inside it."""

    def __init__(self) -> None:
        self.seconds: Seconds = defaultdict(float)
        self._inside = [0.0]

    def timed(self, phase: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, measured as this phase."""

        def run(*args: Any, **kwargs: Any) -> Any:
            self._inside.append(0.0)
            start = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                seconds = time.perf_counter() - start
                self.seconds[phase] += seconds - self._inside.pop()
                self._inside[-1] += seconds

        return run

    def take(self) -> Seconds:
        """The seconds since the last call."""
        taken, self.seconds = dict(self.seconds), defaultdict(float)
        return taken


class Run:
    """A trainer whose steps are measured.

    Args:
        clock: The step of the schedule at which it begins.
    """

    def __init__(
        self, inputs: Inputs, options: TrainOptions, folder: Path, threads: int, clock: int
    ) -> None:
        run = TrainingRun(options, folder, threads=threads)
        backend, self.phases = make_backend("cpu"), Phases()
        self._operators = SimpleNamespace(
            **{
                name: self.phases.timed(phase, getattr(cpu._ops(), name))
                for name, phase in KERNELS.items()
            },
            release_memory=cpu._ops().release_memory,
        )
        scene = load_scene(inputs, run, print)
        state = initial_state(scene, run, backend, print)
        state.gaussians = state.gaussians.with_sh_degree(options.sh_degree)
        state.adam.resize_bands(options.sh_degree)
        state.step = state.clock = clock
        self.trainer = trainer = Trainer(scene, state, run, backend)
        timed = self.phases.timed
        vars(trainer)["control_density"] = timed(CONTROL, trainer.control_density)
        self._step = timed(REST, trainer.step)

    def turn(self) -> Seconds:
        """Run ``TURN`` steps, and return the seconds of each phase."""
        start, busy = time.perf_counter(), busy_seconds()
        with mock.patch.object(cpu, "_ops", lambda: self._operators):
            for _ in range(TURN):
                self._step()
        others = (busy_seconds() - busy) / (time.perf_counter() - start)
        return self.phases.take() | {OTHERS: others}


def busy_seconds() -> float:
    """The processor time that all programs but this one, and other virtual machines, have taken."""
    user, nice, system, _, _, *rest = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + sum(rest)) / os.sysconf("SC_CLK_TCK") - time.process_time()


def once(
    inputs: Inputs,
    options: TrainOptions,
    threads: Sequence[int],
    turns: int,
    wait: Callable[[], None],
) -> Iterator[list[Seconds]]:
    """The seconds of each turn after the first, at each number of threads. ``wait`` is called
    before each turn."""
    with TemporaryDirectory() as folder:
        clock = options.steps // 3 // 100 * 100 + 50
        runs = [Run(inputs, options, Path(folder), number, clock) for number in threads]
        for turn in range(turns + 1):
            # In alternating order: what runs second has the other's data in the cache.
            wait()
            order = runs if turn % 2 else runs[::-1]
            seconds = {id(run): run.turn() for run in order}
            if turn:
                yield [seconds[id(run)] for run in runs]


def medians(repeats: Sequence[Sequence[Sequence[Seconds]]]) -> list[Seconds]:
    """The milliseconds of each phase in a step, at each number of threads: the median over the
    quiet repeats of each turn, and the mean over the turns."""
    found: list[Seconds] = []
    for number in range(len(repeats[0][0])):
        phases: Seconds = defaultdict(float)
        for same in zip(*repeats, strict=True):
            found_here = sorted((turn[number] for turn in same), key=lambda turn: turn[OTHERS])
            quiet = [turn for turn in found_here if turn[OTHERS] < QUIET] or found_here[:1]
            for phase in ORDER:
                here = [turn.get(phase, 0.0) for turn in quiet]
                phases[phase] += 1e3 * statistics.median(here) / TURN / len(repeats[0])
        found.append(phases)
    return found


def wait_for_quiet(seconds: float) -> float:
    """Wait until other programs hardly run, for ``seconds`` at most; return the seconds left."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        busy = busy_seconds()
        time.sleep(SAMPLE)
        if busy_seconds() - busy < QUIET * SAMPLE:
            return left
    return 0.0


def quiet_share(repeats: Sequence[Sequence[Sequence[Seconds]]]) -> float:
    """The share of the turns' repeats in which other programs hardly ran."""
    every = [run[OTHERS] < QUIET for turns in repeats for turn in turns for run in turn]
    return sum(every) / len(every)


class Control:
    """A loop of multiply-adds in registers, on several threads: what the machine gives to them."""

    def __init__(self, threads: int) -> None:
        self.calibration, self.threads = Calibration(), threads
        self._ratios: list[tuple[float, float]] = []

    def measure(self) -> None:
        """Compare the wall time of the loop on one thread and on all."""
        seconds, busy = [], busy_seconds()
        for threads in (1, self.threads):
            start = time.perf_counter()
            for _ in range(3):
                self.calibration.flops(threads)
            seconds.append(time.perf_counter() - start)
        others = (busy_seconds() - busy) / sum(seconds)
        self._ratios.append((others, self.threads * seconds[0] / seconds[1]))

    def speed_up(self) -> float:
        """The median of the quieter half of the measurements."""
        quiet = sorted(self._ratios)[: (len(self._ratios) + 1) // 2]
        return statistics.median(ratio for _, ratio in quiet)


def results(
    scene: str, threads: int, times: Sequence[Mapping[str, float]], control: float
) -> list[SerialResult]:
    """A result for each phase and the step, of the times on one thread and on several."""
    one, many = ({**phases, STEP: sum(phases.values())} for phases in times)
    return [
        SerialResult(scene, threads, phase, one[phase], many[phase], one[STEP], control)
        for phase in (*ORDER, STEP)
    ]


def made_inputs(gaussians: Gaussians, views: list[View]) -> Inputs:
    """The inputs, with light that differs between the photographs as in real scenes."""
    light = [ViewLight(gain=(1 + 0.01 * k, 1.0, 1 - 0.01 * k)) for k in range(len(views))]
    return Inputs(views, gaussians, scene_extent(views), light=light)


@contextmanager
def made_scene(count: int, width: int, height: int) -> Iterator[Inputs]:
    with TemporaryDirectory() as folder:
        views = made_views(VIEWS, width, height, Path(folder))
        yield made_inputs(made_gaussians(count, views[0].fx), views)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gaussians", type=int, default=200_000)
    parser.add_argument("--size", type=int, nargs=2, default=[640, 400], metavar=("W", "H"))
    parser.add_argument("--threads", type=int, default=2, help="against one thread")
    parser.add_argument("--steps", type=int, default=200, help="of each trainer and repeat")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--wait", type=float, default=0.0, help="seconds to wait in all until other programs pause"
    )
    add_record_options(parser)
    args = parser.parse_args()
    options = TrainOptions(density=Gradient(max_gaussians=args.gaussians))
    control, repeats, left = Control(args.threads), [], args.wait

    def wait() -> None:
        nonlocal left
        left = wait_for_quiet(left)

    with made_scene(args.gaussians, *args.size) as inputs, single_torch_thread():
        for _ in range(args.repeats):
            turns = []
            for turn in once(inputs, options, (1, args.threads), args.steps // TURN, wait):
                turns.append(turn)
                control.measure()
            repeats.append(turns)
    scene = f"{args.gaussians} at {args.size[0]}x{args.size[1]}"
    found = results(scene, args.threads, medians(repeats), control.speed_up())
    print(f"{serial_table(found)}\n{forecast_table(found)}")
    print(f"quiet: {quiet_share(repeats):.0%} of the turns")
    if args.json is not None:
        write_record(args.json, measured("serial", args.note), found)
    return 0


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    sys.exit(main())
