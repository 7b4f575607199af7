"""C++ libraries: found where they are built already for this processor, else compiled.

A library lies in ``<root>/<file>-<variant>-<digest>/`` beside ``library.json``, which records the
sources' hash, the variant (``pipeline.runtime.targets``), flags, compiler and versions. Variants
lie side by side, so that the nodes of a mixed cluster can share a folder, and a library is found by
its record without a compiler. The roots are ``pipeline/prebuilt`` (for packages that bring their
libraries) and $SPLATMAKE_CACHE, by default ``build/native`` of the repository, or a folder in the
user's cache where the program is installed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.runtime import targets
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.runtime.layout import IS_CHECKOUT, PACKAGES, PREBUILT, user_cache
from pipeline.runtime.machine import usable_cores
from pipeline.runtime.processor import processor
from pipeline.runtime.targets import Extensions, Target, Variant

RECORD = "library.json"
# In order of preference where $CXX is not set. macOS's g++ is clang under another name.
COMPILERS = ("c++", "clang++") if sys.platform == "darwin" else ("g++", "clang++")

_used: dict[str, Built] = {}


@dataclass(frozen=True)
class Built:
    """A library that is there.

    Attributes:
        target: the variant it is compiled for.
        compiler: the first line of its ``--version``.
    """

    path: Path
    target: str
    compiler: str


def native_facts() -> dict[str, str | None]:
    """The instruction set and the compiler of the libraries that this process used; where it used
    none, the instruction set that one would be looked for, and no compiler."""
    if not _used:
        return {"instruction_set": targets.usable()[0].name, "compiler": None}
    built = _used.values()
    return {
        "instruction_set": ", ".join(dict.fromkeys(b.target for b in built)),
        "compiler": ", ".join(dict.fromkeys(b.compiler for b in built)),
    }


@dataclass(frozen=True)
class NativeLibrary:
    """A shared library of all ``.cpp`` files of a folder.

    Attributes:
        name: what it is, for messages.
        file: the library's file name.
        sources: folder of the sources and headers.
        flags: the compiler's, beside the variant's.
        compile_only, link_only: more of them for one of the two steps; not recorded.
        facts: whatever else decides its bits, by name.
        extensions: see ``targets.usable_variants``.
    """

    name: str
    file: str
    sources: Path
    flags: Sequence[str]
    compile_only: Sequence[str] = ()
    link_only: Sequence[str] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    extensions: Extensions = field(default_factory=dict)

    def source_files(self) -> list[Path]:
        """Sources and headers, sorted by name."""
        return sorted(p for p in self.sources.iterdir() if p.suffix in (".cpp", ".h"))

    def source_hash(self) -> str:
        """Hex digest of the sources. Cheap, and needs no compiler."""
        digest = hashlib.sha256()
        for path in self.source_files():
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
        return digest.hexdigest()

    def build(self) -> Built:
        """The library for this processor, compiled if it is not there yet.

        Raises:
            UserError: no library and no compiler, or it fails; see also ``targets.usable``.
        """
        variants = targets.usable_variants(self.extensions)
        built = self.find(variants[0])
        if built is None and find_compiler() is None:
            # A lesser one is better than none where nothing can be compiled.
            built = next(filter(None, map(self.find, variants[1:])), None)
        _used[self.name] = built or self.compile(variants[0])
        return _used[self.name]

    def find(self, variant: Variant) -> Built | None:
        """A library of this variant that is there already.

        By the compiler that $CXX names. Where $CXX is not set: a prebuilt one, else the newest by
        the default compiler. Where there is no compiler at all: any.
        """
        wanted, command = self._identity(variant), find_compiler()
        chosen = bool(os.environ.get("CXX"))
        found: list[tuple[bool, float, Built]] = []
        for root in _roots():
            prebuilt = root == PREBUILT
            for file in root.glob(f"{self._stem}-{variant.name}-*/{RECORD}"):
                try:
                    record = json.loads(file.read_text())
                    age = -file.stat().st_mtime
                except (OSError, ValueError):  # being replaced, or not ours
                    continue
                path = file.with_name(self.file)
                if any(record.get(name) != value for name, value in wanted.items()):
                    continue
                if chosen and command is not None:
                    same = record["compiler"] == compiler_identity(command)
                else:
                    same = command is None or record["command"] == " ".join(command)
                    same |= prebuilt
                if same and path.is_file():
                    version = record["compiler"].partition("\n")[0]
                    found.append((not prebuilt, age, Built(path, variant.name, version)))
        return min(found, key=lambda item: item[:2], default=(0, 0, None))[2]

    def compile(self, variant: Variant) -> Built:
        """Compile this variant, whether or not this processor can run it.

        It is built in a folder beside and renamed, so that what exists is whole and two builds at
        once are harmless.

        Raises:
            UserError: no compiler, or it fails.
        """
        command = compiler()
        identity = compiler_identity(command)
        record = {**self._identity(variant), "command": " ".join(command), "compiler": identity}
        digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
        root = cache_folder()
        library = root / f"{self._stem}-{variant.name}-{digest[:12]}" / self.file
        root.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=".building-", dir=root))
        try:
            self._compile_into(work, [*command, *self.flags_for(variant)])
            (work / RECORD).write_text(json.dumps(record, indent=2) + "\n")
            work.chmod(0o755)  # mkdtemp's own is for one user alone
            try:
                os.rename(work, library.parent)
            except OSError:
                if not library.exists():  # otherwise another build was first: theirs is as good
                    raise
        finally:
            shutil.rmtree(work, ignore_errors=True)
        return Built(library, variant.name, identity.partition("\n")[0])

    def flags_for(self, variant: Variant) -> list[str]:
        """The compiler's flags for a variant."""
        return [*variant.flags, *self.flags]

    @property
    def _stem(self) -> str:
        return self.file.partition(".")[0]

    def _identity(self, variant: Variant) -> dict[str, Any]:
        """What decides a library's bits beside the compiler."""
        identity: dict[str, Any] = {
            "name": self.name,
            "target": variant.name,
            "flags": self.flags_for(variant),
            "sources": self.source_hash(),
            "system": [sys.platform, variant.target.architecture],
            "facts": dict(self.facts),
        }
        if variant.target.name == "native":
            identity["processor"] = hashlib.sha256("\0".join(processor()).encode()).hexdigest()
        return identity

    def _compile_into(self, folder: Path, command: list[str]) -> None:
        sources = [p for p in self.source_files() if p.suffix == ".cpp"]
        objects = [str(folder / f"{p.stem}.o") for p in sources]

        def compile_one(source: Path, target: str) -> None:
            self._run([*command, *self.compile_only, "-c", str(source), "-o", target])

        with ThreadPoolExecutor(usable_cores()) as pool:
            list(pool.map(compile_one, sources, objects))
        self._run([*command, "-shared", *objects, *self.link_only, "-o", str(folder / self.file)])
        for path in objects:
            os.unlink(path)

    def _run(self, command: list[str]) -> None:
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if "error" in line] or [done.stderr]
            raise UserError(
                f"compiling the {self.name} failed: {errors[0].strip()[:500]}",
                fix=f"run this to see all of it: {' '.join(command)}",
            )


def cache_folder() -> Path:
    """Where libraries are built."""
    chosen = os.environ.get("SPLATMAKE_CACHE")
    if chosen:
        return Path(chosen)
    return PACKAGES / "build" / "native" if IS_CHECKOUT else user_cache() / "native"


def _roots() -> list[Path]:
    return list(dict.fromkeys([PREBUILT, cache_folder()]))


def find_compiler() -> list[str] | None:
    """The C++ compiler's command: $CXX, else the first of ``COMPILERS`` that is installed."""
    for command in [os.environ["CXX"]] if os.environ.get("CXX") else COMPILERS:
        words = command.split()
        if words and shutil.which(words[0]) is not None:
            return words
    return None


def compiler() -> list[str]:
    """The C++ compiler's command. Raises UserError where there is none."""
    found = find_compiler()
    if found is None:
        raise UserError(
            f"no C++ compiler found ({os.environ.get('CXX') or ', '.join(COMPILERS)}), and no "
            "library that is built already",
            fix="install g++ (e.g. apt-get install g++) or clang++, or set CXX",
        )
    return found


def compiler_identity(command: Sequence[str]) -> str:
    """All that a compiler says of its version."""
    done = subprocess.run([*command, "--version"], capture_output=True, text=True)
    return done.stdout.strip() or " ".join(command)


def build_main(make: Callable[[], NativeLibrary], arguments: Sequence[str] | None = None) -> int:
    """The command line that builds a library: its exit code."""
    parser = argparse.ArgumentParser(
        description="Build a native library and print its path. Without --target: for this "
        "processor, if it is not there yet."
    )
    parser.add_argument(
        "--target",
        nargs="+",
        default=[],
        metavar="NAME",
        help="build for these targets, whatever this processor has: "
        f"{', '.join(t.name for t in targets.TARGETS)}, native; or all of this architecture",
    )
    names = parser.parse_args(arguments).target
    try:
        library = make()
        for built in build_targets(library, names) if names else [library.build()]:
            print(built.path)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    return 0


def build_targets(library: NativeLibrary, names: Sequence[str]) -> list[Built]:
    """A library for each variant of the targets named, compiled where it is not there yet.

    Raises:
        UserError: an unknown name, another architecture's without $CXX, or as ``build``.
    """
    wanted: list[Target] = []
    for name in names:
        wanted += targets.of_this_architecture() if name == "all" else [targets.named(name)]
    here = targets.processor.architecture()
    for target in wanted:
        if target.architecture != here and not os.environ.get("CXX"):
            raise UserError(
                f"target {target.name} is of another architecture than this machine's ({here})",
                fix="set CXX to a compiler for it",
            )
    variants = [
        v for t in dict.fromkeys(wanted) for v in targets.all_variants(t, library.extensions)
    ]
    return [library.find(variant) or library.compile(variant) for variant in variants]
