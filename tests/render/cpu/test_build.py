"""Building the kernels: cache, error messages, sanitizers, other instruction sets."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.render.cpu import build
from pipeline.runtime import native, targets
from pipeline.runtime.errors import UserError
from tests.render.cpu.compiled import compiled, linked_driver
from tests.tools import need_sanitizers, unsupported

REPOSITORY = Path(__file__).parents[3]
CHECKS_BY_CALLS = {
    "gcc": ["--param=asan-instrumentation-with-call-threshold=0"],
    "clang": ["-mllvm", "-asan-instrumentation-with-call-threshold=0"],
}


def test_source_hash_needs_no_torch_and_depends_on_the_sources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = (
        "import sys; from pipeline.render.cpu.build import source_hash; print(source_hash());"
        "assert 'torch' not in sys.modules"
    )
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == build.source_hash()
    copy = tmp_path / "csrc"
    shutil.copytree(build.SOURCES, copy)
    monkeypatch.setattr(build, "SOURCES", copy)
    same = build.source_hash()
    with open(copy / "constants.h", "a") as file:
        file.write("\n")
    assert same == done.stdout.strip() != build.source_hash()


def test_a_missing_compiler_is_a_user_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setenv("SPLATMAKE_CACHE", str(tmp_path))
    with pytest.raises(UserError, match=r"no C\+\+ compiler found \(no-such-compiler\)") as error:
        build.build()
    assert "install g++" in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_failing_compiler_leaves_no_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = tmp_path / "broken"
    compiler.write_text(
        "#!/bin/sh\n[ $1 = --version ] || { echo 'x.cpp:1: error: no' >&2; exit 1; }\necho 1\n"
    )
    compiler.chmod(0o755)
    cache = tmp_path / "cache"
    monkeypatch.setenv("CXX", str(compiler))
    monkeypatch.setenv("SPLATMAKE_CACHE", str(cache))
    with pytest.raises(UserError, match="error: no"):
        build.build()
    assert not list(cache.iterdir())


# The real compiler on empty sources; it links once two builds have reached linking.
COMPILER = """#!/bin/sh
[ "$1" = --version ] && exec NAME --version
for word; do
  shift
  case $word in *.cpp) word=FOLDER/empty.cpp ;; -shared) linking=1 ;; esac
  set -- "$@" "$word"
done
if [ "$linking" ]; then
  touch "FOLDER/linking.$$"
  for attempt in $(seq 300); do
    [ "$(ls FOLDER | grep -c linking)" = 2 ] && break
    sleep 0.1
  done
fi
exec NAME "$@"
"""


def test_concurrent_builds_leave_one_complete_library(tmp_path: Path) -> None:
    tools, cache = tmp_path / "tools", tmp_path / "cache"
    tools.mkdir()
    (tools / "empty.cpp").touch()
    script = COMPILER.replace("NAME", " ".join(build.compiler())).replace("FOLDER", str(tools))
    (tools / "compiler").write_text(script)
    (tools / "compiler").chmod(0o755)
    command = [sys.executable, "-m", "pipeline.render.cpu.build"]
    env = {"SPLATMAKE_CACHE": str(cache), "PATH": "/usr/bin:/bin:/usr/local/bin"}
    env["CXX"] = str(tools / "compiler")
    runs = [
        subprocess.Popen(command, cwd=REPOSITORY, env=env, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    paths = {run.communicate()[0].strip() for run in runs}
    assert [run.returncode for run in runs] == [0, 0]
    assert len(list(tools.glob("linking.*"))) == 2, "the builds did not meet"
    (path,) = paths
    assert Path(path).stat().st_size > 0
    assert [p.name for p in cache.iterdir()] == [Path(path).parent.name]
    assert {p.name for p in Path(path).parent.iterdir()} == {Path(path).name, native.RECORD}


@pytest.mark.slow
@pytest.mark.parametrize("kinds", ["address,undefined", "thread"])
def test_sanitizers_find_nothing(tmp_path_factory: pytest.TempPathFactory, kinds: str) -> None:
    """Every kernel on 300 scenes with arbitrary values, on one to three threads."""
    need_sanitizers(build.compiler(), kinds)
    flags = [*targets.usable()[0].flags, "-std=c++17", "-O1", "-g1", "-pthread", "-Wno-psabi"]
    flags += [f"-fsanitize={kinds}", "-fno-sanitize-recover=all"]
    if "address" in kinds:  # checks by calls: inline checks compile slowly
        flags += CHECKS_BY_CALLS["clang" if "clang" in build.compiler()[0] else "gcc"]
    driver = compiled(tmp_path_factory, build.compiler(), flags) / "driver"
    done = subprocess.run([driver], capture_output=True, text=True, timeout=600)
    if "unexpected memory mapping" in done.stderr:
        unsupported("the system's memory layout is not the sanitizer's")
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    assert done.stdout.strip() == "clean"


@pytest.mark.slow
def test_other_instruction_sets_give_equal_results(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The same scene for every target that this machine can run: equal up to rounding."""
    names = [target.name for target in targets.of_this_architecture() if not target.missing]
    if len(names) < 2:
        unsupported("one target alone runs on this processor")
    results = []
    for name in names:
        program = linked_driver(tmp_path_factory, name)
        output = tmp_path / f"out-{name}"
        subprocess.run([program, output], check=True, timeout=600)
        results.append(np.fromfile(output, np.float32).astype(np.float64))
    for other in results[1:]:
        error = np.linalg.norm(other - results[0]) / np.linalg.norm(results[0])
        assert error < 1e-5
