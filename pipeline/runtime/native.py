"""C++ libraries: an existing one for this processor is used, otherwise it is compiled.

A library is in ``<root>/<file>-<variant>-<digest>/`` with ``library.json``, which records the
sources' hash, the variant (``pipeline.runtime.targets``), flags, compiler and versions. Variants
have separate folders, so that the nodes of a mixed cluster can share a root, and libraries are
found without a compiler. The roots are ``pipeline/prebuilt`` (wheels) and $SPLATMAKE_CACHE, by
default ``build/native`` of the repository or, in an installation, the user's cache.
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
# The compilers are in order of preference if $CXX is not set. On macOS, g++ is clang.
COMPILERS = ("c++", "clang++") if sys.platform == "darwin" else ("g++", "clang++")

# Modules whose command line builds a library.
MODULES = ("pipeline.render.cpu.build", "pipeline.sfm.nearest", "pipeline.mvs.patchmatch")

_used: dict[str, Built] = {}


@dataclass(frozen=True)
class Built:
    """A compiled library.

    Attributes:
        target: The variant that it was compiled for.
        compiler: The first line of the compiler's ``--version``.
    """

    path: Path
    target: str
    compiler: str


def native_facts() -> dict[str, str | None]:
    """Instruction set and compiler of the libraries that this process has used. If it has used
    none, the instruction set of this processor's best target, and no compiler."""
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
        name: The name that messages use.
        file: The library's file name.
        sources: The folder of the sources and headers.
        flags: The compiler flags besides the variant's.
        compile_only, link_only: Further flags of one of the two steps, which are not recorded.
        facts: The values of anything else that the library depends on, by name.
        extensions: The extensions of each target (see ``targets.usable_variants``).
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
        """Hex digest of the sources."""
        digest = hashlib.sha256()
        for path in self.source_files():
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
        return digest.hexdigest()

    def build(self) -> Built:
        """The library for this processor, compiled if it does not exist.

        Raises:
            UserError: There is no library and no compiler, or compiling fails; see also
                ``targets.usable``.
        """
        variants = targets.usable_variants(self.extensions)
        built = self.find(variants[0])
        if built is None and find_compiler() is None:
            # Without a compiler, use a library for an older processor if there is one.
            built = next(filter(None, map(self.find, variants[1:])), None)
        _used[self.name] = built or self.compile(variants[0])
        return _used[self.name]

    def find(self, variant: Variant) -> Built | None:
        """An existing library of this variant, or None.

        It must be compiled by $CXX, if that is set. Otherwise a prebuilt library is preferred, then
        the newest by the default compiler. Without a compiler, any library is accepted.
        """
        identity, command = self._identity(variant), find_compiler()
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
                if any(record.get(name) != value for name, value in identity.items()):
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

        It is built in a temporary folder, which is then renamed, so that concurrent builds do not
        interfere.

        Raises:
            UserError: There is no compiler, or compiling fails.
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
            work.chmod(0o755)  # mkdtemp makes it accessible to this user only.
            try:
                os.rename(work, library.parent)
            except OSError:
                if not library.exists():  # Otherwise a concurrent build was first.
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
        """What a library depends on besides the compiler."""
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
                fix=f"run this to see all messages: {' '.join(command)}",
            )


def cache_folder() -> Path:
    """The folder in which libraries are built."""
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
    """The C++ compiler's command.

    Raises:
        UserError: There is no compiler.
    """
    found = find_compiler()
    if found is None:
        raise UserError(
            f"no C++ compiler found ({os.environ.get('CXX') or ', '.join(COMPILERS)}), and no "
            "compiled library",
            fix="install g++ (e.g. apt-get install g++) or clang++, or set CXX",
        )
    return found


def compiler_identity(command: Sequence[str]) -> str:
    """The output of the compiler's ``--version``."""
    done = subprocess.run([*command, "--version"], capture_output=True, text=True)
    return done.stdout.strip() or " ".join(command)


def build_main(make: Callable[[], NativeLibrary], arguments: Sequence[str] | None = None) -> int:
    """The command line that builds a library; returns the exit code."""
    parser = argparse.ArgumentParser(
        description="Build a native library, unless it exists, and print its path. Without "
        "--target: for this processor."
    )
    parser.add_argument(
        "--target",
        nargs="+",
        default=[],
        metavar="NAME",
        help="build for these targets, also if this processor cannot run them: "
        f"{', '.join(t.name for t in targets.TARGETS)}, native; all: all of this architecture",
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
    """A library for each variant of the named targets, compiled if it does not exist.

    Raises:
        UserError: An unknown name, another architecture without $CXX, or as ``build``.
    """
    chosen: list[Target] = []
    for name in names:
        chosen += targets.of_this_architecture() if name == "all" else [targets.named(name)]
    here = targets.processor.architecture()
    for target in chosen:
        if target.architecture != here and not os.environ.get("CXX"):
            raise UserError(
                f"target {target.name} is of another architecture than this machine's ({here})",
                fix="set CXX to a compiler for it",
            )
    variants = [
        v for t in dict.fromkeys(chosen) for v in targets.all_variants(t, library.extensions)
    ]
    return [library.find(variant) or library.compile(variant) for variant in variants]
