"""What a run shows on the terminal: its plan, a line for each finished stage, errors, the result.

Snakemake's own messages are in its log. Stages write to their logs, their progress files and their
records, from which the lines are made: so they are the same for jobs of this machine and of a
cluster.
"""

from __future__ import annotations

import contextlib
import re
import signal
import sys
import threading
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.plan.plan import describe
from pipeline.plan.values import Plan
from pipeline.reporting.headline import batch_lines, finished_line, result_lines
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.runtime.progress import ProgressState, progress_file, progress_text
from pipeline.runtime.record import STAGE, read_run, read_stage
from pipeline.runtime.text import counted, duration
from stages.workflow.failures import reporting_errors
from stages.workflow.folders import RESULTS
from stages.workflow.internals import INTERRUPTED, Flow, listen, log_file
from stages.workflow.outcomes import error_in, interrupted_at, last_lines
from stages.workflow.registry import STAGES
from stages.workflow.screen import Screen
from stages.workflow.targets import explain_missing_rule

# Seconds between two looks at the files of running jobs, on a terminal and elsewhere, and between
# two lines of progress where there is no terminal.
_LIVE_SECONDS, _SECONDS, _LINE_SECONDS = 0.5, 2.0, 60.0
_SECONDS_COLUMN = 72

Stamp = tuple[int, int] | None


@dataclass
class StageJob:
    """A job of a stage that has to run.

    Attributes:
        run: The name of the run, whose folder is ``results/<run>``.
        folder: The stage's folder in it: the stage's name, and the number of the job if the stage
            has several.
    """

    stage: str
    run: str
    folder: str
    results: Path
    earlier: dict[Path, Stamp] = field(init=False)

    def __post_init__(self) -> None:
        self.earlier = {path: _stamp(path) for path in (self.record, self.progress, self.log)}

    def is_new(self, path: Path) -> bool:
        """Whether one of the job's files was written after the job was listed."""
        return _stamp(path) not in (None, self.earlier[path])

    @property
    def record(self) -> Path:
        return self.results / self.run / self.folder / STAGE

    @property
    def progress(self) -> Path:
        return progress_file(self.results / self.run, self.folder)

    @property
    def log(self) -> Path:
        return self.results / self.run / "logs" / f"{self.folder}.log"

    @property
    def title(self) -> str:
        return self.folder.replace("_", " ")


class RunDisplay:
    """Shows a run of Snakemake.

    Args:
        results: The folder of all runs' results.
        started: The time at which Snakemake was started. Older logs are those of other runs.

    Attributes:
        data_root: The folder of the scenes.
    """

    def __init__(self, flow: Flow, screen: Screen, results: Path, started: float):
        self._flow, self._screen, self._results, self._started = flow, screen, results, started
        self.data_root = Path("data")
        self._lock = threading.RLock()
        self._plans: dict[str, Plan] = {}
        self._pending: list[StageJob] = []
        self._done = 0
        self._failed: dict[str, str] = {}
        self._warned: set[str] = set()
        self._batch = False
        self._was_cancelled = False
        self._ended = threading.Event()
        self._last_line = started

    # --- before the jobs ------------------------------------------------------------------

    def planned(self, plan: Plan) -> None:
        """Add the plan of a run."""
        self._plans[plan.scene] = plan

    def start(self) -> None:
        """Show the plans, and then each job of a stage when it ends."""
        with self._lock:
            needed = [job for job in self._flow.needed_jobs() if job.rule.name in STAGES]
            self._pending = [
                StageJob(job.rule.name, job.wildcards.scene, Path(job.log[0]).stem, self._results)
                for job in needed
            ]
            self._pending.sort(key=lambda job: (job.run, _order(job.stage)))
            stages: dict[str, set[str]] = {}
            for job in self._pending:
                stages.setdefault(job.run, set()).add(job.stage)
            self._batch = len(stages) > 1
            self._show_plans(stages, full=False)
            self._print("")
        threading.Thread(target=self._watch, daemon=True).start()

    def dry_run(self) -> None:
        """Show the plans and the jobs that would run."""
        found: dict[str, list[str]] = {}
        for job in self._flow.needed_jobs():
            stage = Path(job.log[0]).stem if job.rule.name in STAGES else job.rule.name
            cause = self._flow.cause(job)
            run = getattr(job.wildcards, "scene", "batch")
            found.setdefault(run, []).append(stage + (f" ({cause})" if cause else ""))
        self._batch = len(found) > 3
        self._show_plans({run: {*_names(jobs)} for run, jobs in found.items()}, full=True)
        for run, jobs in sorted(found.items()):
            self._print(f"{run}: would run {', '.join(sorted(jobs, key=_order))}")
        self._print("this was a dry run: nothing was done")

    def nothing_to_do(self, dry_run: bool) -> None:
        """Show the results of runs that have finished before."""
        if dry_run:
            places = (Path(target).parts for target in self._flow.targets())
            runs = dict.fromkeys(parts[1] for parts in places if len(parts) > 2)
            for name in runs:
                self._print(f"{name}: up to date; its plan is {self._results / name / 'plan.json'}")
            if not runs:
                self._print("the batch is up to date")
        else:
            self._show_results()

    def _show_plans(self, stages: Mapping[str, Collection[str]], *, full: bool) -> None:
        """Show each plan once: all of it, or for several runs its first line.

        Args:
            stages: The stages that have to run, by run.
            full: Whether the decisions of stages are listed, too.
        """
        seen: dict[str, str] = {}
        for run, running in stages.items():
            if run not in self._plans:
                continue
            plan = self._plans[run]
            done = {
                name
                for name, stage in plan.stages.items()
                if stage.run and name not in running
                if (self._results / run / stage.folders(name)[0] / STAGE).is_file()
            }
            shown = {n: s for n, s in plan.stages.items() if not s.run or n in {*running, *done}}
            plan = plan.model_copy(update={"stages": shown})
            # Runs of one scene with the same stages differ in nothing that is shown.
            text = describe(plan.model_copy(update={"scene": ""}), full=full, finished=done)
            first = seen.setdefault(text, run)
            if first != run:
                self._print(f"{run}: the same plan as {first}")
            elif self._batch:
                self._print(describe(plan).splitlines()[0])
            else:
                self._print(run + text)
            self._warned.update(plan.warnings)

    # --- during the jobs ------------------------------------------------------------------

    def poll(self) -> None:
        """Show what has changed since the last call."""
        with self._lock:
            ended = [job for job in self._pending if job.is_new(job.record)]
            if ended:
                self._screen.show([])
            for job in ended:
                self._pending.remove(job)
                self._done += 1
                self._show_finished(job)
            lines = self._progress_lines()
            if not self._was_cancelled:
                self._screen.show(lines)
            now = time.time()
            if not self._screen.live and lines and now - self._last_line >= _LINE_SECONDS:
                self._last_line = now
                self._print("\n".join(lines))

    def job_failed(self, log: Path, end: str) -> None:
        """Show the error of a job, once.

        Args:
            end: How its command ended, for a job that has left no message.
        """
        self.poll()
        with self._lock:
            title = f"{log.stem} of {log.parents[1].name}"
            if title in self._failed or end == INTERRUPTED:
                return
            message = error_in(log, self._started)
            if not message and end.endswith(f" {EXIT_USER_ERROR}"):
                self._failed[title] = end  # On a full disk, the stage prints its message itself.
                return
            if not message:
                lines = last_lines(log, self._started)
                message = "".join(f"\n    {line}" for line in lines)
                message = f"{end or 'it ended without a message'}; see {log}{message}"
            # Configurations of a scene share its errors.
            known = next((other for other, text in self._failed.items() if text == message), None)
            self._failed[title] = message
            self._screen.print(f"error in {title}: {f'as in {known}' if known else message}")
            if self._flow.shows_logs and log.is_file():
                self._screen.print(f"--- {log}\n{log.read_text().rstrip()}\n---")

    def cancelled(self) -> None:
        """Say that the run is being stopped. Jobs save their state; Snakemake itself would end with
        a traceback after a second Ctrl-C, which only they receive from then on."""
        self._was_cancelled = True
        with contextlib.suppress(ValueError):  # Not in the main thread.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        self._screen.show(["stopping: the running stages save their state"])

    def message(self, text: str) -> None:
        """Show a message."""
        self._screen.print(explain_missing_rule(text, self.data_root))

    def _watch(self) -> None:
        seconds = _LIVE_SECONDS if self._screen.live else _SECONDS
        while not self._ended.wait(seconds):
            self.poll()

    def _show_finished(self, job: StageJob) -> None:
        try:
            record, run = read_stage(job.record.parent), read_run(job.record.parent)
            counters = STAGES[job.stage].counters.model_validate(record.counters)
        except (UserError, OSError, ValidationError):
            return  # The next stage has a message.
        if not self._batch:
            found = counters.headline() or ", ".join(STAGES[job.stage].publishes)
            found = found or "; ".join(record.decisions[:1])
            text = f"  {job.title:<10} {found}"
            taken = getattr(run, "taken_from", None)
            text += f" (reused from {taken})" if taken else ""
            self._print(f"{text:<{_SECONDS_COLUMN}} {duration(run.wall_s):>7}".rstrip())
            new = dict.fromkeys(text for text in record.warnings if text not in self._warned)
            self._warned.update(new)
            for warning in new:
                self._print(f"  warning: {warning}")
        elif job.stage == "report":
            with contextlib.suppress(UserError):  # The tables of the batch have a message.
                self._print(finished_line(job.record.parents[1]))

    def _progress_lines(self) -> list[str]:
        """A line for each job that runs."""
        lines = []
        for job in self._pending:
            text = "running" if job.is_new(job.log) else ""
            if job.is_new(job.progress):
                with contextlib.suppress(OSError, ValidationError):
                    state = ProgressState.model_validate_json(job.progress.read_text())
                    text = progress_text(state)
            if text:
                name = f"{job.run}: {job.title}" if self._batch else f"{job.title:<10}"
                lines.append(f"  {name} {text}")
        if self._batch and self._pending:
            lines.append(f"  {counted(self._done, 'stage')} finished, {len(self._pending)} to do")
        return lines

    # --- after the jobs -------------------------------------------------------------------

    def succeeded(self) -> None:
        """Show the results, when all jobs have ended without an error."""
        self._end()
        self._show_results()

    def interrupted(self) -> bool:
        """Show where the user stopped the run. Return False if no one did."""
        self._end()
        stopped = {job.title: interrupted_at(job.log, self._started) for job in self._pending}
        where = [f"{title}{at}" for title, at in stopped.items() if at is not None]
        if where or self._was_cancelled:
            named = f" in {'; '.join(where)}" if where else ""
            self._screen.print(f"stopped{named}: the same command continues")
        return bool(where) or self._was_cancelled

    def failed(self) -> None:
        """Show what is kept, when jobs have failed."""
        self._end()
        number = f"{self._done} of {counted(self._done + len(self._pending), 'stage')}"
        self._print(f"{number} finished; the same command continues. Snakemake's log: {log_file()}")

    def _end(self) -> None:
        self._ended.set()
        self.poll()
        self._screen.show([])

    def _show_results(self) -> None:
        targets = [Path(target) for target in self._flow.targets()]
        if any(target.parent == self._results for target in targets):
            self._print("\n".join(batch_lines(self._results)))
            return
        published = {file for spec in STAGES.values() for file in spec.publishes}
        finished = [
            target.parent
            for target in targets
            if target.parent.parent == self._results and target.name in published
        ]
        for folder in dict.fromkeys(finished):
            with reporting_errors(f"the result of {folder.name}"):
                self._print("\n".join(result_lines(folder)))
        if not finished:
            self._print(f"up to date: {', '.join(map(str, targets))}")

    def _print(self, text: str) -> None:
        if not self._flow.is_quiet:
            self._screen.print(text)


def show_run(workflow: Any) -> RunDisplay:
    """Show the run of a ``workflow`` of Snakemake in the program's own words."""
    flow = Flow(workflow)
    # A plan is what a dry run is for: it can be piped.
    stream = sys.stdout if flow.is_dry_run else sys.stderr
    display = RunDisplay(flow, Screen(stream), RESULTS, time.time())
    if flow.is_shown:
        listen(workflow, display)
    return display


def _order(job: str) -> tuple[int, str]:
    """Sorts jobs as their stages are in the DAG, and others after them."""
    (name,) = _names([job])
    order = list(STAGES)
    return order.index(name) if name in STAGES else len(order), job


def _names(jobs: Iterable[str]) -> list[str]:
    """The stages of jobs such as "block_12 (options changed)"."""
    return [re.sub(r"(_\d+)?( \(.*)?$", "", job) for job in jobs]


def _stamp(path: Path) -> Stamp:
    """Modification time and inode of a file; None without it."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino
