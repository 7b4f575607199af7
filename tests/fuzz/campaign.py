"""Runs cases of a reader under limits of memory and time, in a process of its own.

A process that a case ends (a crash of native code, native code that does not return) is a finding
as well; the campaign continues after it.
"""

from __future__ import annotations

import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NoReturn

from pipeline.runtime.errors import UserError
from tests.fuzz.mutations import mutated
from tests.fuzz.reader import Files, Reader
from tests.fuzz.readers import READERS

MEMORY = 1 << 30
"""Bytes of memory that a case may take beyond those of the idle process."""
RESIDENT = 400 << 20
"""Bytes of them that a case may use at a time."""
SECONDS = 10
"""Seconds of processor time that a case may take: elapsed time counts the work of others, too."""
MAX_MESSAGE = 2000
"""Characters that a message may have."""
WAITING = 60
"""Elapsed seconds after which a case that waits, as for a pipe's writer, is interrupted."""
PATIENCE = 120
"""Elapsed seconds after which the process of a case that has not ended is killed."""
ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Outcome:
    """The result of a campaign.

    Attributes:
        cases: The number of cases that were run.
        read: The number of those that the reader accepted; the others raised a ``UserError``.
        findings: What was raised and where -> the number of the first case that raised it.
    """

    cases: int = 0
    read: int = 0
    findings: dict[str, int] = field(default_factory=dict)

    def add(self, other: Outcome) -> None:
        self.cases += other.cases
        self.read += other.read
        self.findings = other.findings | self.findings


class TooSlowError(Exception):
    """A case took more than ``SECONDS``."""


class BadSeedError(Exception):
    """A reader refuses its own valid files, so its cases would show nothing."""


def content(name: str, reader: Reader, seeds: Sequence[Files], number: int) -> Files:
    """The files of a case; the first one is mutated."""
    rng = random.Random(zlib.crc32(f"{name} {number}".encode()))
    files = dict(rng.choice(seeds))
    first = next(iter(files))
    if rng.random() < 0.5:
        return files | {first: mutated([files[first]], rng)}
    return files | {first: reader.pack(mutated([reader.unpack(files[first])], rng))}


def run(name: str, cases: range, progress: Path | None = None) -> Outcome:
    """Run cases in this process, whose memory is limited meanwhile.

    Args:
        progress: The file that holds the number of the present case, for the process that watches.
    """
    reader = READERS[name]
    seeds = list(reader.seeds())
    outcome = Outcome()
    if not seeds:  # An optional package is missing.
        return outcome
    watched = os.open(progress, os.O_WRONLY | os.O_CREAT) if progress else None
    with tempfile.TemporaryDirectory(dir=_memory_folder()) as root:
        folder = Path(root) / "files"
        for files in seeds:  # Imports, which take memory, happen before the limit.
            _write(folder, files)
            try:
                reader.read(folder)
            except UserError as error:
                raise BadSeedError(f"{name} refuses a valid file: {error}") from None
        with _limits():
            for number in cases:
                if watched is not None:
                    os.pwrite(watched, number.to_bytes(8, "little"), 0)
                _write(folder, content(name, reader, seeds, number))
                found = _judge(reader, folder)
                outcome.cases += 1
                if found is None:
                    outcome.read += 1
                elif found:
                    outcome.findings.setdefault(found, number)
    if watched is not None:
        os.close(watched)
    return outcome


def run_apart(name: str, cases: range) -> Outcome:
    """``run`` in another process, and in further ones after cases that end it."""
    outcome = Outcome()
    with tempfile.TemporaryDirectory() as folder:
        progress = Path(folder) / "progress"
        start = cases.start
        while start < cases.stop:
            progress.write_bytes(b"")
            command = [sys.executable, "-m", "tests.fuzz", "--worker", str(progress), name]
            command += ["--first", str(start), "--cases", str(cases.stop - start)]
            done, output, errors = _watched(command, progress)
            if done == 0:
                outcome.add(Outcome(**json.loads(output.splitlines()[-1])))
                break
            last = (errors.strip().splitlines() or ["no message"])[-1][:200]
            if not progress.stat().st_size:
                raise BadSeedError(errors.strip()[-1000:])
            at = _case_of(progress)
            how = f"the process ended with {done}: {last}"
            if done == -signal.SIGKILL:
                how = f"killed: it did not end within {PATIENCE} s, or the memory was full"
            outcome.add(Outcome(at - start + 1, 0, {how: at}))
            start = at + 1
    return outcome


def _watched(command: Sequence[str], progress: Path) -> tuple[int, str, str]:
    """Run a worker, and kill it after ``PATIENCE`` without a new case; its exit code and output."""
    with (
        tempfile.TemporaryFile("w+", errors="replace") as output,
        tempfile.TemporaryFile("w+", errors="replace") as errors,
        subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=errors) as process,
    ):
        case, since = -1, time.monotonic()
        while process.poll() is None:
            time.sleep(0.1)
            if (now := _case_of(progress)) != case:
                case, since = now, time.monotonic()
            elif time.monotonic() - since > PATIENCE:
                process.kill()
        texts = []
        for file in (output, errors):
            file.seek(0)
            texts.append(file.read())
        return process.returncode, texts[0], texts[1]


def _case_of(progress: Path) -> int:
    """The number of the present case; -1 before the first."""
    data = progress.read_bytes()
    return int.from_bytes(data, "little") if data else -1


def judged(
    reader: Reader, cases: Mapping[str, Files | None], folder: Path
) -> dict[str, str | None]:
    """What ``_judge`` reports about each case, under the limits, in this process.

    Args:
        cases: A name -> its files, or None for those that ``folder`` has.
    """
    found = {}
    with _limits():
        for name, files in cases.items():
            if files is not None:
                _write(folder, files)
            found[name] = _judge(reader, folder)
    return found


def as_json(outcome: Outcome) -> str:
    return json.dumps(asdict(outcome))


def _judge(reader: Reader, folder: Path) -> str | None:
    """None if the reader accepted the files, "" after a UserError, else what was raised where."""
    resident = _reset_peak()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, WAITING)
    start = time.process_time()
    try:
        reader.read(folder)
        found = None
    except UserError as error:
        found = _message_fault(str(error))
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if "/pipeline/" in f.filename or "/tests/" in f.filename][-1]
        what = re.sub(r"\d+", "N", str(error))  # One finding, whatever its numbers are.
        found = f"{type(error).__name__} in {Path(own.filename).name} {own.name}: {what}"[:200]
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
    if found:
        return found
    # Readers that catch every exception catch TooSlowError and MemoryError as well.
    if time.process_time() - start > SECONDS:
        return "too slow"
    if _peak_resident() - resident > RESIDENT:
        return "too much memory"
    return found


def _message_fault(text: str) -> str:
    """What is wrong with a message: empty if it can be read."""
    if len(text) > MAX_MESSAGE:
        return f"a message of more than {MAX_MESSAGE} characters"
    if not all(c.isprintable() or c == "\n" for c in text):
        return "a message with characters that cannot be printed"
    return ""


def _reset_peak() -> int:
    """The resident bytes of this process, with which its peak starts again (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _peak_resident()


def _peak_resident() -> int:
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text()) if status.exists() else None
    return int(found[1]) << 10 if found else 0


def _too_slow(*_: object) -> NoReturn:
    raise TooSlowError


@contextmanager
def _limits() -> Iterator[None]:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before, most = resource.getrlimit(resource.RLIMIT_AS)
    handlers = {kind: signal.signal(kind, _too_slow) for kind in (signal.SIGPROF, signal.SIGALRM)}
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (before, most))
        for kind, handler in handlers.items():
            signal.signal(kind, handler)


def _memory_folder() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def _write(folder: Path, files: Files) -> None:
    if folder.exists() and {path.name for path in folder.iterdir()} != files.keys():
        shutil.rmtree(folder)
    folder.mkdir(exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
