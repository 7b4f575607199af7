"""The installed program: an environment of its own, another folder, and none of the checkout.

Covered: the build, package data, entry point, Snakefile, profiles and API. Not covered: the
resolution and download of dependencies, which are those of the environment that runs the tests.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.runtime import targets
from pipeline.runtime.native import cache_folder
from tests.e2e.harness import ROOT, TINY, copy_run
from tests.install.package import (
    copy_sources,
    install,
    make_environment,
    programs_without_compilers,
    variables,
)
from tests.once import made_once
from tests.render.cpu.compiled import compiled_library

GUIDE = (ROOT / "docs" / "guides" / "python-api.md").read_text()
EXAMPLES = re.findall(r"^```python\n(.+?)^```", GUIDE, re.S | re.M)
CACHE = cache_folder()
CONFIG = [f"{name}={json.dumps(value)}" for name, value in TINY.items()]


def run(
    environment: Path, *command: str, cwd: Path, **more: str
) -> subprocess.CompletedProcess[str]:
    """Run one of the environment's programs; stdout and stderr together in ``stdout``."""
    name, *arguments = command
    done = subprocess.run(
        [str(environment / "bin" / name), *arguments],
        cwd=cwd,
        env=variables(environment, CACHE) | more,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}"
    return done


def _install(folder: Path) -> None:
    sources = copy_sources(folder / "sources")
    install(make_environment(folder / "environment"), sources)


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment in which the program is installed from its sources."""
    return made_once(tmp_path_factory, "installed", _install) / "environment"


@dataclass(frozen=True)
class Reconstruction:
    """A scene that was reconstructed without a compiler.

    Attributes:
        environment: has the program, installed from a wheel with kernels.
        photos, work: the photographs, and the folder in which the program ran.
        cache: the folder in which the program would compile libraries.
    """

    environment: Path
    photos: Path
    work: Path
    cache: Path

    def run(self, *command: str, cwd: Path) -> str:
        """The output of one of the environment's programs, which finds no compiler."""
        path = f"{self.environment / 'bin'}:{self.environment.parent / 'programs'}"
        bare = {"PATH": path, "SPLATMAKE_CACHE": str(self.cache), "CXX": ""}
        return run(self.environment, *command, cwd=cwd, **bare).stdout


@pytest.fixture(scope="session")
def reconstruction(tmp_path_factory: pytest.TempPathFactory, finished: Path) -> Reconstruction:
    """The photographs of ``finished``, reconstructed by the program of a wheel with kernels, in a
    folder that has packages of the program's names, which are the user's."""
    pytest.importorskip("build")
    for target in targets.of_this_architecture():
        compiled_library(tmp_path_factory, target.name)

    def paths(folder: Path) -> Reconstruction:
        names = ("environment", "my photos/tiny", "work", "cache")
        return Reconstruction(*(folder / name for name in names))

    def make(folder: Path) -> None:
        made, sources = paths(folder), copy_sources(folder / "sources")
        subprocess.run(
            ["python", "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), "."],
            cwd=sources,
            env=variables(Path(sys.prefix), CACHE) | {"SPLATMAKE_PREBUILT": "1"},
            check=True,
        )
        (wheel,) = folder.glob("*.whl")
        install(make_environment(made.environment), wheel)
        programs_without_compilers(folder / "programs")
        copy_run(finished / "data", made.photos.parent)
        for name in ("pipeline", "stages"):
            (made.work / name).mkdir(parents=True)
            (made.work / name / "__init__.py").write_text("raise SystemExit('not this one')\n")
        scene, config = str(made.photos), ("--config", *CONFIG)
        planned = made.run("splatmake", "plan", scene, *config, cwd=made.work)
        assert "dry run" in planned and not (made.work / "results/tiny/train").exists()
        made.run("splatmake", "run", scene, "--cores", "2", *config, cwd=made.work)
        made.run("splatmake", "run", scene, "--report", "report.zip", *config, cwd=made.work)

    return paths(made_once(tmp_path_factory, "reconstruction", make))


def site_packages(environment: Path) -> Path:
    return next(environment.glob("lib/python*/site-packages"))


def test_every_file_of_the_packages_is_installed(installed: Path) -> None:
    """Package data is chosen by patterns: a new kind of file would be left out silently."""
    sources = installed.parent / "sources"
    expected = {
        str(path.relative_to(sources))
        for package in ("pipeline", "stages", "splatmake")
        for path in (sources / package).rglob("*")
        if path.is_file() and path.suffix not in (".md", ".pyc")
    }
    packages = site_packages(installed)
    found = {str(path.relative_to(packages)) for path in packages.rglob("*") if path.is_file()}
    assert expected - found == set()
    for name in ("Snakefile", "profiles/default/config.yaml", "profiles/slurm/config.yaml"):
        assert (packages / "pipeline" / "workflow" / name).read_text() == (ROOT / name).read_text()


def test_the_command_runs_outside_of_the_checkout(installed: Path, tmp_path: Path) -> None:
    """Also in a folder with packages of the program's names, which are the user's."""
    for name in ("pipeline", "stages"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('not this one')\n")
    assert "splatmake 0" in run(installed, "splatmake", "--version", cwd=tmp_path).stdout
    report = json.loads(run(installed, "splatmake", "doctor", "--json", cwd=tmp_path).stdout)
    assert report["ready"]
    code = "import pipeline, stages, splatmake; print(pipeline.__file__, splatmake.__file__)"
    places = run(installed, "python", "-P", "-c", code, cwd=tmp_path).stdout.split()
    assert all(place.startswith(str(site_packages(installed))) for place in places), places


def test_libraries_are_not_compiled_into_the_installation(installed: Path, tmp_path: Path) -> None:
    code = "from pipeline.runtime import native; print(native.cache_folder())"
    cache = {"SPLATMAKE_CACHE": "", "XDG_CACHE_HOME": str(tmp_path)}
    found = run(installed, "python", "-c", code, cwd=tmp_path, **cache).stdout.strip()
    assert found == str(tmp_path / "splatmake" / "native")


@pytest.mark.slow
def test_photographs_to_measurements(reconstruction: Reconstruction, finished: Path) -> None:
    """``splatmake run`` on photographs elsewhere gives what a checkout gives."""
    work = reconstruction.work
    ours, theirs = (
        json.loads((place / "results/tiny/metrics.json").read_text()) for place in (work, finished)
    )
    for name in ("psnr", "ssim", "num_gaussians"):
        assert ours[name] == theirs[name]
    assert (work / "report.zip").exists()


@pytest.mark.slow
def test_the_examples_of_the_python_api_run(installed: Path, tmp_path: Path) -> None:
    """All of the guide, in an empty folder; nothing is printed but what the examples print."""
    (demo,) = re.findall(r"^    python (-m pipeline.demo .+)$", GUIDE, re.M)
    run(installed, "python", *shlex.split(demo), cwd=tmp_path)
    assert len(EXAMPLES) >= 10
    (tmp_path / "examples.py").write_text("print('EXAMPLE')\n".join(EXAMPLES))
    printed = run(installed, "python", "-W", "ignore", "examples.py", cwd=tmp_path).stdout
    parts = printed.split("EXAMPLE\n")
    # The output that the guide shows is the program's but for the numbers, which vary by machine.
    shown = re.findall(r"^(?:print\(.+\)  )?# (\w+\(.+\))$", GUIDE, re.M)
    assert len(shown) == 2
    assert {re.sub(r"\d+", "0", line) for line in shown} <= {
        re.sub(r"\d+", "0", line) for line in printed.splitlines()
    }
    results = tmp_path / "scenes/results/garden"
    metrics = json.loads((results / "metrics.json").read_text())
    assert len(parts[0].splitlines()) == 1
    assert parts[2].startswith(f"Quality(PSNR {metrics['psnr']:.2f} dB, ")
    each = [f"{view['name']} {view['psnr']:.2f} dB" for view in metrics["per_view"]]
    assert parts[2].splitlines()[1:] == each
    assert parts[-1].startswith("scenes/results/gadren: ")
    exported = results / "export" / "point_cloud.ply"
    assert (tmp_path / "garden.ply").read_bytes() == exported.read_bytes()
    assert len(list((tmp_path / "frames").glob("*.png"))) == 5


@pytest.mark.slow
def test_the_examples_pass_a_type_checker(installed: Path, tmp_path: Path) -> None:
    """As a user's code: the installed packages say that they are typed, and no part of the API is
    Any."""
    text = "".join(EXAMPLES) + "\nreveal_type(scene.measure().psnr)\nreveal_type(splatmake.load)\n"
    (tmp_path / "example.py").write_text(text)
    # The examples use nothing of torch but a comparison; torch takes most of the time.
    (tmp_path / "mypy.ini").write_text("[mypy]\n[mypy-torch.*]\nfollow_imports = skip\n")
    found = run(
        *(installed, "python", "-m", "mypy", "--strict", "--follow-imports=silent", "example.py"),
        cwd=tmp_path,
    ).stdout
    assert 'Revealed type is "float"' in found or 'Revealed type is "builtins.float"' in found
    assert "Scene" in found


@pytest.mark.slow
def test_a_wheel_with_kernels_needs_no_compiler(
    reconstruction: Reconstruction, tmp_path: Path
) -> None:
    """A reconstruction with every native library from the wheel."""
    report = reconstruction.run("splatmake", "doctor", cwd=tmp_path)
    assert "compiler g++" in report and "ready to run" in report
    used = json.loads((reconstruction.work / "results/tiny/train/run.json").read_text())
    assert used["versions"]["splatmake"] == "0.1.0" and used["commit"] is None
    cache = reconstruction.cache
    assert not cache.exists() or not list(cache.rglob("*.so"))


def test_a_checkouts_command_runs_in_any_folder(tmp_path):
    """Also in one whose files have the names of packages."""
    sources = copy_sources(tmp_path / "sources")
    make_environment(sources / ".venv")
    (sources / ".venv" / "product").touch()
    subprocess.run(["make", "--silent", ".venv/bin/splatmake"], cwd=sources, check=True)
    work = tmp_path / "work"
    for name in ("pipeline", "random"):
        (work / name).mkdir(parents=True)
        (work / f"{name}.py").write_text("raise SystemExit(9)\n")
    shown = run(sources / ".venv", "splatmake", "options", "train.steps", cwd=work).stdout
    assert shown.startswith("train.steps: whole number")
