"""Runs cases of a reader under limits of memory and time, in a process of its own.

A process that a case ends (a crash of native code, a limit that Python cannot enforce) is a finding
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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NoReturn

from pipeline.runtime.errors import UserError
from tests.fuzz.mutations import mutated
from tests.fuzz.reader import Files, Reader
from tests.fuzz.readers import READERS

MEMORY = 1 << 30
"""Bytes of memory that a case may take beyond those of the idle process."""
SECONDS = 10
"""Time that a case may take."""
ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Outcome:
    """The result of a campaign.

    Attributes:
        cases: number of cases that were run.
        read: number of those that the reader accepted; the others raised a ``UserError``.
        findings: what was raised and where -> number of the first case that raised it.
    """

    cases: int = 0
    read: int = 0
    findings: dict[str, int] = field(default_factory=dict)

    def add(self, other: Outcome) -> None:
        self.cases += other.cases
        self.read += other.read
        self.findings = other.findings | self.findings


class TooSlowError(Exception):
    """A case took longer than ``SECONDS``."""


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
        progress: file that holds the number of the present case, for the process that watches.
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
            reader.read(folder)
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
            progress.write_bytes(start.to_bytes(8, "little"))
            command = [sys.executable, "-m", "tests.fuzz", "--worker", str(progress), name]
            command += ["--first", str(start), "--cases", str(cases.stop - start)]
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
            if done.returncode == 0:
                outcome.add(Outcome(**json.loads(done.stdout.splitlines()[-1])))
                break
            at = int.from_bytes(progress.read_bytes(), "little")
            last = (done.stderr.strip().splitlines() or ["no message"])[-1][:200]
            how = f"the process ended with {done.returncode}: {last}"
            outcome.add(Outcome(at - start + 1, 0, {how: at}))
            start = at + 1
    return outcome


def as_json(outcome: Outcome) -> str:
    return json.dumps(asdict(outcome))


def _judge(reader: Reader, folder: Path) -> str | None:
    """None if the reader accepted the files, "" after a UserError, else what was raised where."""
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    start = time.monotonic()
    try:
        reader.read(folder)
    except UserError as error:
        text = str(error)
        return "" if len(text) < 5000 else f"a message of {len(text)} characters"
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if "/pipeline/" in f.filename or "/tests/" in f.filename][-1]
        what = re.sub(r"\d+", "N", str(error))  # One finding, whatever its numbers are.
        return f"{type(error).__name__} in {Path(own.filename).name} {own.name}: {what}"[:200]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return None if time.monotonic() - start < SECONDS else "too slow"


def _too_slow(*_: object) -> NoReturn:
    raise TooSlowError


@contextmanager
def _limits() -> Iterator[None]:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before, most = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, _too_slow)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (before, most))
        signal.signal(signal.SIGALRM, handler)


def _memory_folder() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def _write(folder: Path, files: Files) -> None:
    if folder.exists() and {path.name for path in folder.iterdir()} != files.keys():
        shutil.rmtree(folder)
    folder.mkdir(exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
