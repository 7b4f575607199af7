"""The serial part of training steps on a CPU, by phase: Amdahl's law from 1 and several threads.

    python -m benchmarks.serial --gaussians 200000 --size 640 400 --json FILE

Trains a synthetic scene from the middle of the schedule, with density control, by two trainers in
turns: on one thread and on ``--threads``. Both compute the same bits, so that each turn is the same
work, and so is each repeat of the whole measurement. A turn has the steps from one densification
to the next. Times are medians over the repeats of a turn in which other programs took less than 4 %
of one core, or the repeat in which they took least.
Kernels are timed one by one. The rest of a step, in Python and torch, runs on one thread.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, Self
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
from pipeline.splats import rows
from pipeline.splats.gaussians import Gaussians
from pipeline.training.data.inputs import Inputs
from pipeline.training.density.gradient import GradientDensity
from pipeline.training.loop.setup import initial_state, load_scene
from pipeline.training.loop.trainer import Trainer
from pipeline.training.run import TrainingRun

VIEWS = 48
KERNELS = {
    "project": "projection, SH",
    "bin": "bin",
    "blend": "blend",
    "l1_ssim": "loss",
    "blend_backward": "blend backward",
    "project_backward_update": "projection backward, Adam",
}
CONTROL, REST = "density control", "other Python and torch"
ORDER = (*dict.fromkeys(KERNELS.values()), CONTROL, REST)
# The time that other programs run, over the time on the clock, in a turn that counts as quiet.
QUIET = 0.04
SAMPLE = 0.5  # seconds for which other programs are watched before a turn


@dataclass(frozen=True)
class Time:
    """A time on the clock, and that of all threads together while they do not wait."""

    wall: float = 0.0
    busy: float = 0.0

    @staticmethod
    def now() -> Time:
        wall, (loops, threads) = time.perf_counter(), cpu._ops().loop_time()
        return Time(wall, wall - loops + threads - Pool.loops + Pool.threads)

    def __add__(self, other: Time) -> Time:
        return Time(self.wall + other.wall, self.busy + other.busy)

    def __sub__(self, other: Time) -> Time:
        return Time(self.wall - other.wall, self.busy - other.busy)


class Pool(ThreadPoolExecutor):
    """The pool that searches and copies rows (``for_ranges``).

    Attributes:
        loops, threads: The seconds of all pools together, and of their threads at work.
    """

    loops = threads = 0.0

    def __enter__(self) -> Self:
        self._start = time.perf_counter()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        Pool.loops += time.perf_counter() - self._start

    def map(  # type: ignore[override]
        self, work: Callable[..., Any], *items: Any
    ) -> Iterator[Any]:
        def timed(*item: Any) -> tuple[Any, float]:
            start = time.perf_counter()
            return work(*item), time.perf_counter() - start

        for found, seconds in super().map(timed, *items):
            Pool.threads += seconds
            yield found


class Phases:
    """Adds up the times of phases, each without the phases inside it."""

    def __init__(self) -> None:
        self.times: dict[str, Time] = defaultdict(Time)
        self._inside = [Time()]

    def timed(self, phase: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, measured as this phase."""

        def run(*args: Any, **kwargs: Any) -> Any:
            self._inside.append(Time())
            start = Time.now()
            try:
                return call(*args, **kwargs)
            finally:
                taken = Time.now() - start
                self.times[phase] += taken - self._inside.pop()
                self._inside[-1] += taken

        return run

    def take(self) -> dict[str, Time]:
        """The times since the last call."""
        taken, self.times = dict(self.times), defaultdict(Time)
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
            loop_time=cpu._ops().loop_time,
        )
        scene = load_scene(inputs, run, print)
        state = initial_state(scene, run, backend, print)
        state.gaussians = state.gaussians.with_sh_degree(options.sh_degree)
        state.adam.resize_bands(options.sh_degree)
        state.step = state.clock = options.steps // 3
        assert isinstance(state.density, GradientDensity)
        self.interval = state.density.timeline.interval
        self.trainer = trainer = Trainer(scene, state, run, backend)
        timed = self.phases.timed
        vars(trainer)["control_density"] = timed(CONTROL, trainer.control_density)
        self._timed_step = timed(REST, trainer.step)

    def step(self) -> None:
        with (
            mock.patch.object(cpu, "_ops", lambda: self._operators),
            mock.patch.object(rows, "ThreadPoolExecutor", Pool),
        ):
            self._timed_step()

    def turn(self) -> Turn:
        """Run the steps from one densification to the next."""
        start, others = time.perf_counter(), others_seconds()
        for _ in range(self.interval):
            self.step()
        share = (others_seconds() - others) / (time.perf_counter() - start)
        scale = 1e3 / self.interval
        times = self.phases.take().items()
        return Turn({phase: Time(scale * t.wall, scale * t.busy) for phase, t in times}, share)


@dataclass(frozen=True)
class Turn:
    """The mean times of the phases of a step, milliseconds, and the share of it in which other
    programs ran."""

    times: Mapping[str, Time]
    others: float


def others_seconds() -> float:
    """The processor time that all programs but this one, and other virtual machines, have taken."""
    user, nice, system, _, _, *rest = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + sum(rest)) / os.sysconf("SC_CLK_TCK") - time.process_time()


def once(
    inputs: Inputs, options: TrainOptions, threads: int, turns: int, wait: Callable[[], None]
) -> Iterator[list[Turn]]:
    """Each turn after the first, on one thread and on ``threads``. ``wait`` is called before each
    of them."""
    with TemporaryDirectory() as folder:
        trainers = [Run(inputs, options, Path(folder), number) for number in (1, threads)]
        for number in range(turns + 1):
            found = []
            for trainer in trainers:
                wait()
                found.append(trainer.turn())
            if number:
                yield found


def medians(repeats: Sequence[Sequence[Sequence[Turn]]]) -> list[dict[str, Time]]:
    """The milliseconds of each phase in a step, at each number of threads: the median over the
    quiet repeats of each turn, and the mean over the turns."""
    found: list[dict[str, Time]] = []
    for number in range(len(repeats[0][0])):
        phases: dict[str, Time] = defaultdict(Time)
        for same in zip(*repeats, strict=True):
            turns = sorted((turn[number] for turn in same), key=lambda turn: turn.others)
            quiet = [turn for turn in turns if turn.others < QUIET] or turns[:1]
            for phase in ORDER:
                times = [turn.times.get(phase, Time()) for turn in quiet]
                phases[phase] += Time(
                    statistics.median(time.wall for time in times) / len(repeats[0]),
                    statistics.median(time.busy for time in times) / len(repeats[0]),
                )
        found.append(phases)
    return found


def wait_for_quiet(seconds: float) -> float:
    """Wait until other programs hardly run, for ``seconds`` at most; return the seconds left."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        others = others_seconds()
        time.sleep(SAMPLE)
        if others_seconds() - others < QUIET * SAMPLE:
            return left
    return 0.0


def quiet_share(repeats: Sequence[Sequence[Sequence[Turn]]]) -> float:
    """The share of the turns' repeats in which other programs hardly ran."""
    every = [turn.others < QUIET for turns in repeats for both in turns for turn in both]
    return sum(every) / len(every)


def made_options(count: int) -> TrainOptions:
    return TrainOptions(density=Gradient(max_gaussians=count))


def results(scene: str, threads: int, found: Sequence[Mapping[str, Time]]) -> list[SerialResult]:
    """A result for each phase and the step, of the times on one thread and on ``threads``."""
    one, many = ({**phases, STEP: sum(phases.values(), Time())} for phases in found)
    return [
        SerialResult(
            scene, threads, phase, one[phase].wall, many[phase].wall, many[phase].busy,
            one[STEP].wall,
        )
        for phase in (*ORDER, STEP)
    ]  # fmt: skip


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
    parser.add_argument(
        "--turns", type=int, default=3, help="densifications of each trainer and repeat"
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--wait", type=float, default=0.0, help="seconds to wait in all until other programs pause"
    )
    add_record_options(parser)
    args = parser.parse_args()
    repeats, left = [], args.wait
    options = made_options(args.gaussians)

    def wait() -> None:
        nonlocal left
        left = wait_for_quiet(left)

    with made_scene(args.gaussians, *args.size) as inputs, single_torch_thread():
        for _ in range(args.repeats):
            repeats.append(list(once(inputs, options, args.threads, args.turns, wait)))
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
