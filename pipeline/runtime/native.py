"""C++ compiled where it runs, at first use, into a library that is named by all that decides it."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from pipeline.runtime.errors import UserError
from pipeline.runtime.machine import processor


@dataclass(frozen=True)
class NativeLibrary:
    """A shared library of all ``.cpp`` files of a folder.

    It lands in ``build/native/<key>/`` of the repository, or under $SPLATMAKE_CACHE, where the key
    is a hash of all that decides its bits. It is built in a folder beside and renamed, so that what
    exists is whole and two builds at once are harmless.

    Attributes:
        name: what it is, for messages.
        file: the library's file name.
        sources: folder of the sources and headers.
        flags: the compiler's.
        compile_only, link_only: more of them for one of the two steps; not part of the key.
        facts: whatever else decides its bits.
    """

    name: str
    file: str
    sources: Path
    flags: Sequence[str]
    compile_only: Sequence[str] = ()
    link_only: Sequence[str] = ()
    facts: Sequence[str] = ()

    def source_files(self) -> list[Path]:
        """Sources and headers, sorted by name."""
        return sorted(p for p in self.sources.iterdir() if p.suffix in (".cpp", ".h"))

    def source_hash(self) -> str:
        """Hex digest of the sources. Cheap, and needs no compiler."""
        digest = hashlib.sha256()
        for path in self.source_files():
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
        return digest.hexdigest()

    def key(self) -> str:
        """Names the library by everything that decides its bits."""
        command = compiler()
        version = subprocess.run([*command, "--version"], capture_output=True, text=True).stdout
        parts = [self.source_hash(), " ".join(command), version, " ".join(self.flags)]
        parts += [*self.facts, *processor()]
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]

    def build(self) -> Path:
        """The library for this machine, compiled if it is not there yet.

        Raises:
            UserError: no compiler, or it fails.
        """
        chosen = os.environ.get("SPLATMAKE_CACHE")
        root = Path(chosen) if chosen else Path(__file__).parents[2] / "build" / "native"
        library = root / self.key() / self.file
        if library.exists():
            return library
        command = [*compiler(), *self.flags]
        root.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=".building-", dir=root))
        try:
            sources = [p for p in self.source_files() if p.suffix == ".cpp"]
            objects = [str(work / f"{p.stem}.o") for p in sources]

            def compile_one(source: Path, target: str) -> None:
                self._run([*command, *self.compile_only, "-c", str(source), "-o", target])

            with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
                list(pool.map(compile_one, sources, objects))
            self._run([*command, "-shared", *objects, *self.link_only, "-o", str(work / self.file)])
            for path in objects:
                os.unlink(path)
            try:
                os.rename(work, library.parent)
            except OSError:
                if not library.exists():  # otherwise another build was first: theirs is as good
                    raise
        finally:
            shutil.rmtree(work, ignore_errors=True)
        return library

    def _run(self, command: list[str]) -> None:
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if "error" in line] or [done.stderr]
            raise UserError(
                f"compiling the {self.name} failed: {errors[0].strip()[:500]}",
                fix=f"run this to see all of it: {' '.join(command)}",
            )


def compiler() -> list[str]:
    """The C++ compiler's command, $CXX or g++. Raises UserError where there is none."""
    command = os.environ.get("CXX", "g++").split()
    if not command or shutil.which(command[0]) is None:
        name = command[0] if command else "$CXX"
        raise UserError(
            f"no C++ compiler found ({name})",
            fix="install g++ (e.g. apt-get install g++) or set CXX",
        )
    return command
