"""What every stage needs around its work: identity, lock, atomic outputs, sidecars, errors.

A stage owns one folder. Its work is written to a scratch folder and put in place by a rename
when all is done, so that what exists is whole. Two sidecars stand beside the outputs:

- ``stage.json``: the same for the same work. Key, digests of inputs and outputs, counters,
  decisions, warnings.
- ``run.json``: how this run went. Versions, commit, machine, instruction set, wall and CPU time,
  peak memory.

A stage whose key and inputs are those of its finished folder is not worked again: Snakemake
deletes a job's declared outputs before it runs it, so a hidden copy of ``stage.json`` lets the
stage see that the work is there, check the digests, and put the declared file back. Finished work
of the same identity in a neighbouring folder (another configuration of the scene) is taken over by
hard links in the same way.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import platform
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from pipeline.runtime import targets
from pipeline.runtime.atomic import replace_folder, write_bytes, write_json
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError, as_user_error
from pipeline.runtime.layout import IS_CHECKOUT, PACKAGES
from pipeline.runtime.machine import machine_facts
from pipeline.runtime.memory import peak_memory_mb
from pipeline.runtime.native import native_facts
from pipeline.runtime.progress import Console, write_progress_to
from pipeline.runtime.section import read_section

SIDE_CARS = ("stage.json", "run.json", ".stage.json")

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
    with _logging_to(request.log, request.out.parent.name):
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
    with _locked(scratch_root / f"{request.stage}.lock", request):
        digests = {role: content_digest(folder) for role, folder in request.inputs.items()}
        _recover(request.out)
        if _is_done(request, digests):
            write_bytes(request.out / "stage.json", (request.out / ".stage.json").read_bytes())
            _publish(request)
            print(f"{request.stage}: up to date, nothing to do", file=sys.stderr)
            return 0
        stage_scratch = scratch_root / request.stage
        scratch = stage_scratch / _identity(request.key, digests)[:16]
        out = scratch / "out"
        if out.exists():
            shutil.rmtree(out)
        out.mkdir(parents=True)
        if _taken_over(request, digests, out):
            shutil.rmtree(stage_scratch, ignore_errors=True)
            return 0
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
        _write_sidecars(job, digests, time.perf_counter() - start)
        replace_folder(out, request.out)
        _publish(request)
        shutil.rmtree(stage_scratch, ignore_errors=True)
    return 0


# --- identity ---------------------------------------------------------------------------------


def canonical(value: Any) -> str:
    """Canonical JSON: sorted keys, no spaces, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def content_digest(folder: Path) -> str:
    """Digest of what a finished stage made: its outputs, not how or from what it made them.

    Ground truth (below ``truth/``) is left out: no stage's result may depend on it, and those
    that measure against it have it in their keys.
    """
    record = read_stage(folder)
    content = {name: record[name] for name in ("outputs", "counters", "warnings")}
    content["outputs"] = {k: v for k, v in content["outputs"].items() if not k.startswith("truth/")}
    return hashlib.sha256(canonical(content).encode()).hexdigest()


def read_stage(folder: Path) -> dict[str, Any]:
    """The parsed ``stage.json`` of a finished stage's folder."""
    path = folder / "stage.json"
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise UserError(
            "this stage's output is missing", file=path, fix="run snakemake again"
        ) from None


def is_current(folder: Path, key: str, inputs: Mapping[str, Path]) -> bool:
    """Whether the stage that owns ``folder`` has finished with this key and with what its inputs
    (folder by role) now contain."""
    try:
        record = read_stage(folder)
        digests = {role: content_digest(path) for role, path in inputs.items()}
    except (UserError, OSError, ValueError):
        return False
    return canonical(record["key"]) == key and record["inputs"] == digests


def _identity(key: Mapping[str, Any], inputs: Mapping[str, str]) -> str:
    return hashlib.sha256(canonical({"key": key, "inputs": inputs}).encode()).hexdigest()


def _is_done(request: Request, inputs: dict[str, str]) -> bool:
    hidden = request.out / ".stage.json"
    if not hidden.is_file():
        return False
    try:
        record = json.loads(hidden.read_text())
        same = _identity(record["key"], record["inputs"]) == _identity(request.key, inputs)
    except (ValueError, KeyError):
        return False
    return same and _digests(request.out) == record["outputs"]


def _taken_over(request: Request, inputs: dict[str, str], out: Path) -> bool:
    """Put a neighbour's finished work in place, if one has done exactly what is asked for.

    Its files are hard links where the file system has them. Stages replace files and never write
    into them, so that neither folder can change the other; the digests are those of the links.
    """
    wanted = _identity(request.key, inputs)
    for hidden in sorted(request.out.parents[1].glob(f"*/{request.stage}/.stage.json")):
        source = hidden.parent
        try:
            record = json.loads(hidden.read_text())
            run = json.loads((source / "run.json").read_text())
            if source == request.out or _identity(record["key"], record["inputs"]) != wanted:
                continue
        except (OSError, ValueError, KeyError):
            continue
        with contextlib.suppress(OSError):  # It may be replaced at this moment.
            shutil.copytree(source, out, copy_function=_link, dirs_exist_ok=True)
        if _digests(out) == record["outputs"]:
            record["scene"] = request.out.parent.name
            write_json(out / "run.json", run | {"taken_from": source.parent.name})
            write_json(out / ".stage.json", record)
            write_json(out / "stage.json", record)
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
        if (out / ".stage.json").exists():
            shutil.rmtree(old)
        else:
            shutil.rmtree(out, ignore_errors=True)
            old.rename(out)


def _digests(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in SIDE_CARS)
    return {p.relative_to(folder).as_posix(): file_digest(p) for p in files}


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# --- sidecars ---------------------------------------------------------------------------------


def _write_sidecars(job: Job, inputs: dict[str, str], wall: float) -> None:
    record = {
        "stage": job.stage,
        "scene": job.scene,
        "key": job.key,
        "inputs": inputs,
        "outputs": _digests(job.out),
        "counters": job.counters,
        "decisions": job.decisions,
        "warnings": job.warnings,
    }
    write_json(job.out / "run.json", run_facts(job, wall))
    write_json(job.out / ".stage.json", record)
    write_json(job.out / "stage.json", record)


def run_facts(job: Job, wall: float) -> dict[str, Any]:
    """How a run went: times in seconds, memory in MiB, versions, commit, machine,
    instruction set."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "wall_s": round(wall, 3),
        "cpu_s": round(sum(u.ru_utime + u.ru_stime for u in (own, children)), 3),
        "peak_rss_mb": round(peak_memory_mb(), 1),
        "threads": job.threads,
        "seed": job.key["seed"],
        **machine_facts(),
        **native_facts(),
        "versions": versions(),
        "commit": _commit(),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        **job.timings,
    }


def versions() -> dict[str, str]:
    """Versions of Python and of the packages whose results we depend on."""
    found = {"python": platform.python_version()}
    for name in (
        "torch",
        "pycolmap",
        "opencv-contrib-python-headless",
        "numpy",
        "scipy",
        "rawpy",
        "snakemake",
        # A checkout has a commit instead.
        *(() if IS_CHECKOUT else ("splatmake",)),
    ):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found


def _commit() -> str | None:
    """The checkout's commit. An installed package may lie in someone else's repository."""
    if not IS_CHECKOUT:
        return None
    git = ["git", "-C", str(PACKAGES), "rev-parse", "HEAD"]
    try:
        done = subprocess.run(git, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None


def _publish(request: Request) -> None:
    for name, target in request.publish.items():
        write_bytes(target, (request.out / name).read_bytes())


# --- lock and log -----------------------------------------------------------------------------


@contextmanager
def _locked(path: Path, request: Request) -> Iterator[None]:
    """Hold the stage's lock: a job orphaned by a killed Snakemake may still be writing."""
    with open(path, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            print(
                f"{request.stage}: another run is at work on {request.out}; waiting for it",
                file=sys.stderr,
                flush=True,
            )
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextmanager
def _logging_to(path: Path | None, name: str) -> Iterator[None]:
    if path is None:
        yield
        return
    terminal = sys.stderr
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        log = open(path, "w")  # noqa: SIM115  (closed below)
    except OSError:
        # The work itself will meet the same trouble and say so in full.
        yield
        return
    with log:
        console = Console(terminal, log, f"{name}: ")
        sys.stderr = console  # type: ignore[assignment]
        try:
            yield
        finally:
            console.clear()
            console.flush()
            sys.stderr = terminal
