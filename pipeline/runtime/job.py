"""What every stage needs around its work: identity, lock, atomic outputs, records, errors.

A stage owns one folder. Its work is written to a scratch folder and put in place by a rename when
all is done, so that what exists is whole. Its records (``pipeline.runtime.record``) stand beside
its outputs.

A stage whose key and inputs are those of its finished folder is not run again: Snakemake deletes a
job's declared outputs before it runs the job, so a hidden copy of ``stage.json`` lets the stage see
that the work is there, check the digests, and put the declared file back. Finished work of the same
identity in a neighbouring folder (another configuration of the scene) is taken over by hard links
in the same way. Before a stage works, the files of its inputs are compared with their records.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from pipeline.runtime import targets
from pipeline.runtime.atomic import replace_folder, write_bytes, write_json
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError, as_user_error
from pipeline.runtime.facts import run_record
from pipeline.runtime.lock import locked, logging_to
from pipeline.runtime.progress import write_progress_to
from pipeline.runtime.record import (
    HIDDEN_STAGE,
    RUN,
    STAGE,
    RunRecord,
    StageRecord,
    canonical,
    check_outputs,
    content_digest,
    identity,
    output_digests,
    read_record,
)
from pipeline.runtime.section import read_section

S = TypeVar("S", bound=BaseModel)


@dataclass
class Job:
    """One stage's work on one scene.

    Attributes:
        stage, scene: names.
        key: the stage's key as a parsed JSON object (see ``pipeline.plan.keys``).
        inputs: folder of each input role ("photos", "model", ...).
        out: write outputs here; it becomes the stage's folder when ``run`` returns.
        scratch: survives a kill and is found again by a run with the same identity.
        shared_cache: survives changed options; for content-addressed per-image results.
        threads: native threads to use; never changes a result.
        memory_mb: that the stage may use, None where nothing was said; never changes a result.
        counters, decisions, warnings: recorded in ``stage.json``; fill them in.
        published: extra declared outputs: file in ``out`` -> path where it is wanted as well.
        timings: recorded in ``run.json``.
        logs: folder for what tells how a run went; not part of the result.
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
    counters: dict[str, Any] = field(default_factory=dict)
    decisions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    published: dict[str, Path] = field(default_factory=dict)
    timings: dict[str, Any] = field(default_factory=dict)

    @property
    def seed(self) -> int:
        """The run's seed; only stages that have it in their key may ask."""
        return int(self.key["seed"])

    def section(self, model: type[S]) -> S:
        """The config section of type ``model``, with the options that the stage declares."""
        return read_section(model, self.key["config"][model.__name__.lower()])

    def record(self, report: Any) -> None:
        """Take over a report (a dataclass): its ``decisions`` and ``warnings`` are told and kept,
        its other fields become counters."""
        facts = asdict(report)
        self.tell(facts.pop("decisions", []), facts.pop("warnings", []))
        self.counters |= facts

    def run_record(self, wall: float) -> RunRecord:
        """How the run has gone for ``wall`` seconds."""
        seed = self.key["seed"]
        return run_record(wall, threads=self.threads, seed=seed, timings=self.timings)

    def tell(self, decisions: Sequence[str], warnings: Sequence[str]) -> None:
        for text in decisions:
            self.decide(text)
        for text in warnings:
            self.warn(text)

    def warn(self, text: str) -> None:
        print(f"warning: {text}", file=sys.stderr, flush=True)
        self.warnings.append(text)

    def decide(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)
        self.decisions.append(text)


@dataclass(frozen=True)
class Request:
    """What a stage's command line asks for."""

    stage: str
    key: dict[str, Any]
    inputs: dict[str, Path]
    out: Path
    threads: int
    log: Path | None
    publish: dict[str, Path]
    memory_mb: int | None = None


def run_stage(request: Request, work: Callable[[Job], None]) -> int:
    """Run ``work`` as a stage and return the process's exit code.

    0: done, or there already. 2: the user must mend something (one clear message). Any other
    exception is a bug of the program: exit code 1, with a traceback.
    """
    with logging_to(request.log, request.out.parent.name):
        try:
            targets.usable()  # a wrong $SPLATMAKE_TARGET ends the run before any work
            return _run_locked(request, work)
        except UserError as error:
            _say_error(request, error)
            return EXIT_USER_ERROR
        except MemoryError:
            _say_error(request, UserError("out of memory", fix="lower views.max_long_side_px"))
            return EXIT_USER_ERROR
        except sqlite3.OperationalError as error:
            fix = "free some space and make results/ writable, then run again"
            _say_error(request, UserError(f"the database cannot be written: {error}", fix=fix))
            return EXIT_USER_ERROR
        except OSError as error:
            known = as_user_error(error)
            if known is None:
                traceback.print_exc(file=sys.stderr)
                return 1
            _say_error(request, known)
            return EXIT_USER_ERROR
        except Exception:
            traceback.print_exc(file=sys.stderr)
            return 1


def _say_error(request: Request, error: UserError) -> None:
    scene = request.out.parent.name
    print(f"error in {request.stage} of {scene}: {error}", file=sys.stderr, flush=True)


def _run_locked(request: Request, work: Callable[[Job], None]) -> int:
    scene_folder = request.out.parent
    scratch_root = scene_folder / ".scratch"
    scratch_root.mkdir(parents=True, exist_ok=True)
    with locked(scratch_root / f"{request.stage}.lock", request.stage, request.out):
        digests = {role: content_digest(folder) for role, folder in request.inputs.items()}
        _recover(request.out)
        if _is_done(request, digests):
            write_bytes(request.out / STAGE, (request.out / HIDDEN_STAGE).read_bytes())
            _publish(request)
            print(f"{request.stage}: up to date, nothing to do", file=sys.stderr)
            return 0
        stage_scratch = scratch_root / request.stage
        scratch = stage_scratch / identity(request.key, digests)[:16]
        out = scratch / "out"
        if out.exists():
            shutil.rmtree(out)
        out.mkdir(parents=True)
        if _taken_over(request, digests, out):
            shutil.rmtree(stage_scratch, ignore_errors=True)
            return 0
        check_outputs(request.inputs.values(), request.threads)
        job = Job(
            stage=request.stage,
            scene=scene_folder.name,
            key=request.key,
            inputs=request.inputs,
            out=out,
            scratch=scratch,
            shared_cache=scratch_root / f"{request.stage}-cache",
            threads=request.threads,
            memory_mb=request.memory_mb,
            logs=scene_folder / "logs" if request.log is None else request.log.parent,
        )
        # Temporary files belong on the results' disk, where a kill leaves them to be found.
        os.environ["TMPDIR"] = str(scratch / "tmp")
        (scratch / "tmp").mkdir(exist_ok=True)
        tempfile.tempdir = None
        write_progress_to(scene_folder / ".scratch" / "progress.json")
        start = time.perf_counter()
        try:
            work(job)
        except BaseException:
            shutil.rmtree(out, ignore_errors=True)
            raise
        finally:
            write_progress_to(None)
        _write_records(job, digests, time.perf_counter() - start)
        replace_folder(out, request.out)
        _publish(request)
        shutil.rmtree(stage_scratch, ignore_errors=True)
    return 0


def _is_done(request: Request, inputs: dict[str, str]) -> bool:
    record = _finished(request.out)
    if record is None or record.identity != identity(request.key, inputs):
        return False
    return output_digests(request.out, request.threads) == record.outputs


def _finished(folder: Path) -> StageRecord | None:
    """The hidden record of a finished stage. A damaged one is as good as none: the work is done
    again."""
    try:
        return read_record(folder / HIDDEN_STAGE, StageRecord)
    except (UserError, OSError):
        return None


def _taken_over(request: Request, inputs: dict[str, str], out: Path) -> bool:
    """Put a neighbour's finished work in place, if one has done exactly what is asked for.

    Its files are hard links where the file system has them. Stages replace files and never write
    into them, so that neither folder can change the other; the digests are those of the links.
    """
    wanted = identity(request.key, inputs)
    for hidden in sorted(request.out.parents[1].glob(f"*/{request.stage}/{HIDDEN_STAGE}")):
        source = hidden.parent
        record = _finished(source)
        if source == request.out or record is None or record.identity != wanted:
            continue
        try:
            run = read_record(source / RUN, RunRecord)
        except (UserError, OSError):
            continue
        with contextlib.suppress(OSError):  # It may be replaced at this moment.
            shutil.copytree(source, out, copy_function=_link, dirs_exist_ok=True)
        if output_digests(out, request.threads) == record.outputs:
            taken = run.model_copy(update={"taken_from": source.parent.name})
            _write(out, record.model_copy(update={"scene": request.out.parent.name}), taken)
            replace_folder(out, request.out)
            _publish(request)
            print(f"{request.stage}: taken over from {source.parent.name}", file=sys.stderr)
            return True
        shutil.rmtree(out)
        out.mkdir()
    return False


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _recover(out: Path) -> None:
    """A kill between the two renames of ``replace_folder`` leaves the former folder aside."""
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
        counters=json.loads(canonical(job.counters)),  # tuples become lists
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
