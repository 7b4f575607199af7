"""Targets, and native libraries for several of them side by side, found without a compiler."""

from __future__ import annotations

import ctypes
import json
import os
from pathlib import Path

import pytest

from pipeline.runtime import native, processor, targets
from pipeline.runtime.errors import UserError
from pipeline.runtime.native import Built, NativeLibrary
from pipeline.runtime.targets import Extension, Variant

V2, V3, V4 = (targets.named(f"x86-64-v{level}") for level in (2, 3, 4))
VNNI = {"x86-64-v3": [Extension("avx_vnni", ("-mavxvnni",))]}
# A "compiler" that says its name and version, and writes its flags where the library should be.
COMPILER = """#!/bin/sh
[ "$1" = --version ] && { echo "NAME 1.0"; exit; }
for word; do [ "$previous" = -o ] && echo "NAME $@" > "$word"; previous=$word; done
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An x86-64-v3 machine with g++ and clang++ on its PATH, which is the folder returned."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("g++", "clang++"):
        (folder / name).write_text(COMPILER.replace("NAME", name))
        (folder / name).chmod(0o755)
    monkeypatch.setattr(native, "COMPILERS", ("g++", "clang++"))
    monkeypatch.setattr(native, "PREBUILT", tmp_path / "prebuilt")
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setenv("SPLATMAKE_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.delenv(targets.VARIABLE, raising=False)
    monkeypatch.setattr(native, "_used", {})
    has(monkeypatch, V3.features)
    return folder


def has(monkeypatch: pytest.MonkeyPatch, features: frozenset[str]) -> None:
    monkeypatch.setattr(processor, "architecture", lambda: "x86-64")
    monkeypatch.setattr(processor, "features", lambda: features)


def library(tmp_path: Path, text: str = "", **more) -> NativeLibrary:
    sources = tmp_path / "csrc"
    sources.mkdir(exist_ok=True)
    (sources / "one.cpp").write_text(f'extern "C" int one() {{ return 1; }}{text}\n')
    return NativeLibrary("thing", "libthing.so", sources, ["-O1", "-fPIC"], **more)


def built(tmp_path: Path) -> list[str]:
    return sorted(path.name.rpartition("-")[0] for path in (tmp_path / "cache").iterdir())


def remove_compilers(folder: Path) -> None:
    for file in folder.iterdir():
        file.unlink()


def test_the_best_target_that_the_processor_has_is_used(monkeypatch):
    monkeypatch.delenv(targets.VARIABLE, raising=False)
    for features, names in [
        (V2.features, ["x86-64-v2"]),
        (V3.features | {"avx512f"}, ["x86-64-v3", "x86-64-v2"]),
        (V4.features, ["x86-64-v4", "x86-64-v3", "x86-64-v2"]),
    ]:
        has(monkeypatch, features)
        assert [target.name for target in targets.usable()] == names


def test_an_older_processor_and_an_unknown_architecture_are_named(monkeypatch):
    monkeypatch.delenv(targets.VARIABLE, raising=False)
    has(monkeypatch, frozenset({"pni"}))
    with pytest.raises(UserError, match=r"lacks cx16, .*sse4_2"):
        targets.usable()
    monkeypatch.setattr(processor, "architecture", lambda: "riscv64")
    with pytest.raises(UserError, match="unsupported architecture") as error:
        targets.usable()
    assert "SPLATMAKE_TARGET=native" in str(error.value)


def test_a_target_is_forced_by_its_name(here, tmp_path, monkeypatch):
    monkeypatch.setenv(targets.VARIABLE, "x86-64-v2")
    assert library(tmp_path).build().target == "x86-64-v2"
    assert built(tmp_path) == ["libthing-x86-64-v2"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("x86-64-v9", "unknown instruction-set target 'x86-64-v9'; expected one of x86-64-v2,"),
        ("x86-64-v4", "lacks avx512bw, avx512cd, avx512dq, avx512f, avx512vl"),
        ("aarch64", "lacks the aarch64 architecture"),
    ],
)
def test_a_forced_target_that_cannot_run_is_one_clear_error(
    here, tmp_path, monkeypatch, name, message
):
    monkeypatch.setenv(targets.VARIABLE, name)
    with pytest.raises(UserError, match=message):
        library(tmp_path).build()
    assert not (tmp_path / "cache").exists()


def test_extensions_are_used_where_the_processor_has_them(here, tmp_path, monkeypatch):
    assert library(tmp_path, extensions=VNNI).build().target == "x86-64-v3"
    has(monkeypatch, V3.features | {"avx_vnni"})
    extended = library(tmp_path, extensions=VNNI).build()
    assert extended.target == "x86-64-v3+avx_vnni"
    assert "-march=x86-64-v3 -mavxvnni" in extended.path.read_text()
    monkeypatch.setenv(targets.VARIABLE, "x86-64-v2")
    assert library(tmp_path, extensions=VNNI).build().target == "x86-64-v2"


def test_two_targets_lie_side_by_side(here, tmp_path, monkeypatch, capsys):
    arguments = ["--target", "x86-64-v2", "x86-64-v4"]
    assert native.build_main(lambda: library(tmp_path), arguments) == 0
    paths = capsys.readouterr().out.split()
    assert built(tmp_path) == ["libthing-x86-64-v2", "libthing-x86-64-v4"]
    remove_compilers(here)
    # Each node of a cluster that shares the folder takes the best that it can run.
    for target, path in [(V2, paths[0]), (V3, paths[0]), (V4, paths[1])]:
        has(monkeypatch, target.features)
        assert str(library(tmp_path).build().path) == path


def test_all_targets_of_this_architecture_are_built_once(here, tmp_path):
    thing = library(tmp_path, extensions=VNNI)
    first = native.build_targets(thing, ["all"])
    names = ["x86-64-v4", "x86-64-v3", "x86-64-v3+avx_vnni", "x86-64-v2"]
    assert [b.target for b in first] == names
    assert native.build_targets(thing, ["x86-64-v2", "all"]) == [first[3], *first[:3]]


def test_the_command_line_names_what_is_wrong(here, tmp_path, capsys):
    for name, message in [("x", "unknown instruction-set target 'x'"), ("aarch64", "set CXX")]:
        assert native.build_main(lambda: library(tmp_path), ["--target", name]) == 2
        assert message in capsys.readouterr().err


def test_a_prebuilt_library_needs_no_compiler(here, tmp_path, monkeypatch):
    thing = library(tmp_path)
    monkeypatch.setenv("SPLATMAKE_CACHE", str(native.PREBUILT))
    monkeypatch.setenv("CXX", "clang++")
    prebuilt = thing.build()
    monkeypatch.setenv("SPLATMAKE_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CXX")
    assert thing.build() == prebuilt == Built(prebuilt.path, "x86-64-v3", "clang++ 1.0")
    remove_compilers(here)
    assert thing.build() == prebuilt
    assert not (tmp_path / "cache").exists()
    with pytest.raises(UserError, match=r"no C\+\+ compiler found \(g\+\+, clang\+\+\)"):
        library(tmp_path, "// changed sources").build()


def test_cxx_selects_the_compiler_and_gplusplus_is_the_default(here, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "clang++")
    by_clang = library(tmp_path).build()
    monkeypatch.delenv("CXX")
    by_gcc = library(tmp_path).build()
    assert (by_clang.compiler, by_gcc.compiler) == ("clang++ 1.0", "g++ 1.0")
    monkeypatch.setenv("CXX", "clang++")
    assert library(tmp_path).build() == by_clang
    monkeypatch.delenv("CXX")
    (here / "g++").unlink()
    assert library(tmp_path).build() == by_clang
    assert native.compiler() == ["clang++"]


def test_another_version_of_the_compiler_that_cxx_names_compiles_again(here, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "g++")
    before = library(tmp_path).build()
    (here / "g++").write_text(COMPILER.replace("NAME 1.0", "g++ 2.0").replace("NAME", "g++"))
    after = library(tmp_path).build()
    assert after.path != before.path and after.compiler == "g++ 2.0"


@pytest.mark.parametrize("change", ["sources", "flags", "facts"])
def test_what_decides_the_bits_makes_another_library(here, tmp_path, change):
    first = library(tmp_path).build().path
    more: dict = {"text": "// more"} if change == "sources" else {}
    if change == "facts":
        more = {"facts": {"torch": "9"}}
    other = library(tmp_path, **more)
    if change == "flags":
        other = NativeLibrary(other.name, other.file, other.sources, ["-O2"])
    assert other.build().path != first
    assert library(tmp_path).build().path == first


def test_native_serves_this_processor_alone(here, tmp_path, monkeypatch):
    monkeypatch.setenv(targets.VARIABLE, "native")
    monkeypatch.setattr(native, "processor", lambda: ["one model"])
    first = library(tmp_path).build()
    assert first.target == "native" and library(tmp_path).build() == first
    monkeypatch.setattr(native, "processor", lambda: ["another model"])
    assert library(tmp_path).build().path != first.path


def test_the_record_and_run_json_say_what_a_library_is(here, tmp_path):
    assert native.native_facts() == {"instruction_set": "x86-64-v3", "compiler": None}
    found = library(tmp_path, facts={"torch": "2"}).build()
    record = json.loads((found.path.parent / native.RECORD).read_text())
    assert record["target"] == "x86-64-v3" and record["compiler"] == "g++ 1.0"
    assert record["facts"] == {"torch": "2"} and "-O1" in record["flags"]
    assert native.native_facts() == {"instruction_set": "x86-64-v3", "compiler": "g++ 1.0"}


def test_a_real_compiler_builds_what_can_be_loaded(tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATMAKE_CACHE", str(tmp_path / "cache"))
    thing = library(tmp_path)
    names = [target.name for target in targets.of_this_architecture() if not target.missing]
    for found in native.build_targets(thing, names):
        assert ctypes.CDLL(os.fspath(found.path)).one() == 1
    assert thing.find(Variant(targets.usable()[0])) is not None
