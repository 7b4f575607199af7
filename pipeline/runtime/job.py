"""Running a stage: lock, scratch folder, atomic outputs, records, reuse of results, errors.

A stage has one folder. Its output is written to a scratch folder, which is renamed when the stage
has finished. Records (``pipeline.runtime.record``) are stored with the outputs.

A stage does no work if its folder holds results for the same key and inputs. Snakemake deletes a
job's declared outputs before it runs the job, so the stage recognises this by a hidden copy of
``stage.json``, checks the digests of its files, and restores the declared output. Equal results of
another run (another configuration of the scene) are reused by hard links. Before a stage works, the
files of its inputs are compared with their records.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from pipeline.runtime import targets
from pipeline.runtime.atomic import link_or_copy, replace_folder, write_bytes, write_json
from pipeline.runtime.counters import NoCounters, StageCounters
from pipeline.runtime.errors import (
    EXIT_INTERRUPTED,
    EXIT_USER_ERROR,
    ChangedFileError,
    UserError,
    as_user_error,
)
from pipeline.runtime.facts import run_record
from pipeline.runtime.layout import SCAN_CACHE
from pipeline.runtime.lock import locked, logging_to
from pipeline.runtime.progress import position, progress_file, write_progress_to
from pipeline.runtime.record import (
    HIDDEN_STAGE,
    RUN,
    STAGE,
    RunRecord,
    StageRecord,
    check_outputs,
    content_digest,
    identity,
    output_digests,
    read_record,
)
from pipeline.runtime.section import read_section
from pipeline.runtime.termination import EXIT_TERMINATED, Terminated, raising_when_terminated

S = TypeVar("S", bound=BaseModel)


@dataclass
class Job:
    """The interface of a running stage.

    Attributes:
        stage: The name of the stage's folder.
        scene: The name of the scene or run.
        key: The stage's key as a parsed JSON object (see ``pipeline.plan.keys``).
        inputs: The folder of each input by its role ("photos", "model", ...).
        out: The folder for the outputs, which becomes the stage's folder at the end.
        scratch: The folder that a later run with the same key and inputs finds if this one is
            killed.
        shared_cache: The folder for per-image results that are addressed by content and
            independent of the key.
        threads: The number of native threads, which does not affect results.
        memory_mb: The memory limit, or None, which does not affect results.
        counters, decisions, warnings: The content of ``stage.json``. The counters are of the
            model that the stage declares.
        timings: Further facts for ``run.json``.
        logs: The folder for logs, which are not part of the result.
    """

    stage: str
    scene: str
    key: dict[str, Any]
    inputs: dict[str, Path]
    out: Path
    scratch: Path
    shared_cache: Path
    threads: int
    memory_mb: int | None
    logs: Path
    counters: StageCounters = field(default_factory=NoCounters)
    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timings: dict[str, Any] = field(default_factory=dict)

    @property
    def seed(self) -> int:
        """The run's seed. Only stages whose key contains it have one."""
        return int(self.key["seed"])

    @property
    def number(self) -> int:
        """The number of the job, from 1. Only stages with several jobs have it."""
        return int(self.key["job"])

    @property
    def of_jobs(self) -> int:
        """The number of the stage's jobs. Only stages with several have it."""
        return int(self.key["jobs"])

    def cache_of(self, stage: str) -> Path:
        """The ``shared_cache`` of another stage."""
        return self.shared_cache.with_name(f"{stage}-cache")

    def section(self, model: type[S]) -> S:
        """The config section of type ``model``, with the options that the stage declares."""
        return read_section(model, self.key["config"][model.__name__.lower()])

    def record(
        self, counters: StageCounters, decisions: Sequence[str] = (), warnings: Sequence[str] = ()
    ) -> None:
        """Record the counters; print and record decisions and warnings."""
        self.counters = counters
        self.add_messages(decisions, warnings)

    def run_record(self, wall: float) -> RunRecord:
        """The record of the run after ``wall`` seconds."""
        seed = self.key["seed"]
        return run_record(wall, threads=self.threads, seed=seed, timings=self.timings)

    def add_messages(self, decisions: Sequence[str], warnings: Sequence[str]) -> None:
        """Print and record decisions and warnings."""
        for text in decisions:
            self.decide(text)
        for text in warnings:
            self.warn(text)

    def warn(self, text: str) -> None:
        """Print and record a warning."""
        print(f"warning: {text}", file=sys.stderr, flush=True)
        self.warnings.append(text)

    def decide(self, text: str) -> None:
        """Print and record a decision."""
        print(text, file=sys.stderr, flush=True)
        self.decisions.append(text)


@dataclass(frozen=True)
class Request:
    """The arguments of a stage's command line.

    Attributes:
        stage: The name of the stage. The name of its folder ``out`` ends with the number of the
            job if the stage has several.
    """

    stage: str
    key: dict[str, Any]
    inputs: dict[str, Path]
    out: Path
    threads: int
    log: Path | None
    publish: dict[str, Path]
    memory_mb: int | None = None

    def __str__(self) -> str:
        """The job and its scene, as in messages."""
        return f"{self.name} of {self.out.parent.name}"

    @property
    def name(self) -> str:
        """The name of the folder, under which the job is recorded."""
        return self.out.name


def run_stage(
    request: Request,
    work: Callable[[Job], None],
    counters: type[StageCounters] = NoCounters,
) -> int:
    """Run ``work`` as a stage and return the exit code.

    Args:
        counters: The model of the counters that ``work`` must record.

    0: finished, or up to date. 2: a ``UserError``, with its message. 130: interrupted by Ctrl-C.
    1: another exception, which is a bug of the program, with a traceback.
    """
    with logging_to(request.log, request.out.parent.name), raising_when_terminated():
        try:
            targets.usable()  # Reports a wrong $SPLATMAKE_TARGET before any work.
            return _run_locked(request, work, counters)
        except KeyboardInterrupt:
            at = f" at {position()}" if position() else ""
            print(f"{request.name}: stopped{at}", file=sys.stderr, flush=True)
            return EXIT_INTERRUPTED
        except Terminated:
            print(f"{request} was terminated (SIGTERM or SIGHUP)", file=sys.stderr, flush=True)
            return EXIT_TERMINATED
        except Exception as error:
            known = _known(error)
            if known is None:
                traceback.print_exc(file=sys.stderr)
                return 1
            if isinstance(known, ChangedFileError):
                # The facts that the scan has cached about the scene's files may be wrong.
                (request.out.parent / SCAN_CACHE).unlink(missing_ok=True)
            print(f"error in {request}: {known}", file=sys.stderr, flush=True)
            return EXIT_USER_ERROR


def _known(error: Exception) -> UserError | None:
    """The message for an error that the user can correct; None for a bug of the program."""
    if isinstance(error, UserError):
        return error
    if isinstance(error, MemoryError):
        return UserError("out of memory", fix="lower views.max_long_side_px")
    if isinstance(error, sqlite3.OperationalError):
        fix = "free some space and make results/ writable, then run again"
        return UserError(f"the database cannot be written: {error}", fix=fix)
    return as_user_error(error) if isinstance(error, OSError) else None


def _run_locked(
    request: Request, work: Callable[[Job], None], counters: type[StageCounters]
) -> int:
    scene_folder = request.out.parent
    scratch_root = scene_folder / ".scratch"
    scratch_root.mkdir(parents=True, exist_ok=True)
    with locked(scratch_root / f"{request.name}.lock", request.name, request.out):
        digests = {role: content_digest(folder) for role, folder in request.inputs.items()}
        _recover(request.out)
        if _is_done(request, digests, counters):
            write_bytes(request.out / STAGE, (request.out / HIDDEN_STAGE).read_bytes())
            _publish(request)
            print(f"{request.name}: up to date, nothing to do", file=sys.stderr)
            return 0
        stage_scratch = scratch_root / request.name
        scratch = stage_scratch / identity(request.key, digests)[:16]
        out = scratch / "out"
        if out.exists():
            shutil.rmtree(out)
        out.mkdir(parents=True)
        if _reuse_other_run(request, digests, counters, out):
            shutil.rmtree(stage_scratch, ignore_errors=True)
            return 0
        check_outputs(request.inputs.values(), request.threads)
        job = Job(
            stage=request.name,
            scene=scene_folder.name,
            key=request.key,
            inputs=request.inputs,
            out=out,
            scratch=scratch,
            shared_cache=scratch_root / f"{request.name}-cache",
            threads=request.threads,
            memory_mb=request.memory_mb,
            logs=scene_folder / "logs" if request.log is None else request.log.parent,
        )
        # Temporary files belong to the scratch folder, which the next run removes after a kill.
        os.environ["TMPDIR"] = str(scratch / "tmp")
        (scratch / "tmp").mkdir(exist_ok=True)
        tempfile.tempdir = None
        write_progress_to(progress_file(scene_folder, request.name))
        start = time.perf_counter()
        try:
            work(job)
            _check_counters(job, counters)
            _write_records(job, digests, time.perf_counter() - start)
        except BaseException:
            shutil.rmtree(out, ignore_errors=True)
            raise
        finally:
            write_progress_to(None)
        replace_folder(out, request.out)
        _publish(request)
        shutil.rmtree(stage_scratch, ignore_errors=True)
    return 0


def _check_counters(job: Job, model: type[StageCounters]) -> None:
    """Raises: TypeError: the stage recorded no counters, or other ones than it declares."""
    if type(job.counters) is not model:
        found = type(job.counters).__name__
        raise TypeError(f"stage {job.stage} declares {model.__name__}, and recorded {found}")
    # A copy with changed fields is not validated when it is made.
    model.model_validate(job.counters.recorded())


def _is_done(request: Request, inputs: dict[str, str], counters: type[StageCounters]) -> bool:
    record = _finished(request.out, counters)
    if record is None or record.identity != identity(request.key, inputs):
        return False
    return output_digests(request.out, request.threads) == record.outputs


def _finished(folder: Path, counters: type[StageCounters]) -> StageRecord | None:
    """The hidden record of a finished stage; None if it is missing or damaged."""
    try:
        record = read_record(folder / HIDDEN_STAGE, StageRecord)
        counters.model_validate(record.counters)
    except (UserError, OSError, ValidationError):
        return None
    return record


def _reuse_other_run(
    request: Request, inputs: dict[str, str], counters: type[StageCounters], out: Path
) -> bool:
    """Link the results of another run with the same key and inputs, if there is one."""
    required = identity(request.key, inputs)
    for hidden in sorted(request.out.parents[1].glob(f"*/{request.name}/{HIDDEN_STAGE}")):
        source = hidden.parent
        record = _finished(source, counters)
        if source == request.out or record is None or record.identity != required:
            continue
        try:
            run = read_record(source / RUN, RunRecord)
        except (UserError, OSError):
            continue
        with contextlib.suppress(OSError):  # The folder may just be replaced.
            shutil.copytree(source, out, copy_function=link_or_copy, dirs_exist_ok=True)
        if output_digests(out, request.threads) == record.outputs:
            reused = run.model_copy(update={"taken_from": source.parent.name})
            _write(out, record.model_copy(update={"scene": request.out.parent.name}), reused)
            replace_folder(out, request.out)
            _publish(request)
            print(f"{request.name}: reused from {source.parent.name}", file=sys.stderr)
            return True
        shutil.rmtree(out)
        out.mkdir()
    return False


def _recover(out: Path) -> None:
    """Restore the former folder after a kill between the two renames of ``replace_folder``."""
    old = out.with_name(f".{out.name}.old")
    if old.exists():
        if (out / HIDDEN_STAGE).exists():
            shutil.rmtree(old)
        else:
            shutil.rmtree(out, ignore_errors=True)
            old.rename(out)


def _write_records(job: Job, inputs: dict[str, str], wall: float) -> None:
    record = StageRecord(
        stage=job.stage,
        scene=job.scene,
        key=job.key,
        inputs=inputs,
        outputs=output_digests(job.out, job.threads),
        counters=job.counters.recorded(),
        decisions=tuple(job.decisions),
        warnings=tuple(job.warnings),
    )
    _write(job.out, record, job.run_record(wall))


def _write(out: Path, record: StageRecord, run: RunRecord) -> None:
    write_json(out / RUN, run.model_dump(mode="json"))
    for name in (HIDDEN_STAGE, STAGE):
        write_json(out / name, record.model_dump(mode="json"))


def _publish(request: Request) -> None:
    for name, target in request.publish.items():
        write_bytes(target, (request.out / name).read_bytes())
