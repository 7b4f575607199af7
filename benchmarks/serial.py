"""The serial part of training steps on a CPU, by phase: Amdahl's law from 1 and several threads.

    python -m benchmarks.serial --gaussians 200000 --size 640 400 --json FILE

Trains a synthetic scene from the middle of the schedule, with density control, by trainers in
turns: on one thread, on ``--threads``, and on one thread while other processes do the same, so that
all threads are busy. All compute the same bits, so that each turn
is the same work, and so is each repeat of the whole measurement. Times are medians over the repeats
of a turn in which other programs took less than 4 % of one core, or the repeat in which they took
least. Kernels are timed one by one. The rest of a step, in Python and torch, runs on one thread.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing.synchronize import Barrier, Event
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.memory import made_gaussians, made_views
from benchmarks.record_tables import forecast_table, serial_table
from benchmarks.results import STEP, SerialResult
from pipeline.config.density import Gradient
from pipeline.config.settled import TrainOptions
from pipeline.render import make_backend
from pipeline.render.cpu import backend as cpu
from pipeline.runtime.torch_threads import single_torch_thread
from pipeline.scene.exposure import ViewLight
from pipeline.scene.views import View, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.setup import initial_state, load_scene
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
    """A trainer whose steps are measured, from a third of the schedule on."""

    def __init__(self, inputs: Inputs, options: TrainOptions, folder: Path, threads: int) -> None:
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
        state.step = state.clock = options.steps // 3
        self.trainer = trainer = Trainer(scene, state, run, backend)
        timed = self.phases.timed
        vars(trainer)["control_density"] = timed(CONTROL, trainer.control_density)
        self._timed_step = timed(REST, trainer.step)

    def step(self) -> None:
        with mock.patch.object(cpu, "_ops", lambda: self._operators):
            self._timed_step()

    def turn(self) -> Seconds:
        """Run ``TURN`` steps, and return the seconds of each phase."""
        start, busy = time.perf_counter(), busy_seconds()
        for _ in range(TURN):
            self.step()
        others = (busy_seconds() - busy) / (time.perf_counter() - start)
        return self.phases.take() | {OTHERS: others}


def busy_seconds() -> float:
    """The processor time that all programs but this one, and other virtual machines, have taken."""
    user, nice, system, _, _, *rest = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + sum(rest)) / os.sysconf("SC_CLK_TCK") - time.process_time()


def once(
    inputs: Inputs,
    options: TrainOptions,
    copies: Copies,
    threads: int,
    turns: int,
    wait: Callable[[], None],
) -> Iterator[list[Seconds]]:
    """The seconds of each turn after the first: on one thread, on ``threads``, and on one thread
    beside the copies. ``wait`` is called before each turn."""
    with TemporaryDirectory() as folder:
        one, many, beside = (
            Run(inputs, options, Path(folder), number) for number in (1, threads, 1)
        )
        for turn in range(turns + 1):
            wait()
            seconds = [one.turn(), many.turn()]
            with copies.running():
                seconds.append(beside.turn())
            seconds[-1][OTHERS] -= threads - 1
            if turn:
                yield seconds


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


class Copies:
    """Other processes that train the same scene on one thread each: with this one, a perfectly
    parallel program of the same arithmetic without shared state.

    Args:
        count: The number of processes.
        arguments: Those of ``copy``.
    """

    def __init__(self, count: int, arguments: tuple[int, int, int]) -> None:
        context = multiprocessing.get_context("spawn")
        self._go, started = context.Event(), context.Barrier(count + 1)
        self._processes = [
            context.Process(target=copy, args=(*arguments, self._go, started), daemon=True)
            for _ in range(count)
        ]
        for process in self._processes:
            process.start()
        started.wait()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Let them train inside."""
        self._go.set()
        yield
        self._go.clear()
        time.sleep(SAMPLE)  # Their steps end.


def copy(count: int, width: int, height: int, go: Event, started: Barrier) -> None:
    """Train while ``go`` is set."""
    torch.set_num_threads(1)
    with made_scene(count, width, height) as inputs, TemporaryDirectory() as folder:
        run = Run(inputs, made_options(count), Path(folder), 1)
        started.wait()
        while True:
            go.wait()
            run.step()


def made_options(count: int) -> TrainOptions:
    return TrainOptions(density=Gradient(max_gaussians=count))


def results(scene: str, threads: int, times: Sequence[Mapping[str, float]]) -> list[SerialResult]:
    """A result for each phase and the step, of the times in the order of ``SerialResult``."""
    one, many, beside = ({**phases, STEP: sum(phases.values())} for phases in times)
    return [
        SerialResult(scene, threads, phase, one[phase], many[phase], beside[phase], one[STEP])
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
    repeats, left = [], args.wait
    options, made = made_options(args.gaussians), (args.gaussians, *args.size)
    copies = Copies(args.threads - 1, made)

    def wait() -> None:
        nonlocal left
        left = wait_for_quiet(left)

    with made_scene(*made) as inputs, single_torch_thread():
        for _ in range(args.repeats):
            turns = once(inputs, options, copies, args.threads, args.steps // TURN, wait)
            repeats.append(list(turns))
    scene = f"{args.gaussians} at {args.size[0]}x{args.size[1]}"
    found = results(scene, args.threads, medians(repeats))
    print(f"{serial_table(found)}\n{forecast_table(found)}")
    print(f"quiet: {quiet_share(repeats):.0%} of the turns")
    if args.json is not None:
        write_record(args.json, measured("serial", args.note), found)
    return 0


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    sys.exit(main())
