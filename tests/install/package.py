"""The program installed from its sources into an environment of its own."""

from __future__ import annotations

import os
import shutil
import site
import subprocess
import sys
from pathlib import Path

from tests.e2e.harness import ROOT

PROGRAMS = ("bash", "cat", "env", "mkdir", "rm", "sh", "uname", "which")
"""What Snakemake, its plugins and its jobs may call beside Python."""


def copy_sources(target: Path) -> Path:
    """Copy the files that git tracks or would add: neither builds nor results."""
    listed = subprocess.run(
        ["git", "ls-files", "-coz", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():  # neither deleted nor a linked folder
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, target / name)
    return target


def make_environment(folder: Path) -> Path:
    """Make a virtual environment without packages of its own and return its Python. It sees the
    dependencies of this environment, which does not contain the program."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    packages = next(folder.glob("lib/python*/site-packages"))
    (packages / "dependencies.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    return folder / "bin" / "python"


def install(python: Path, source: Path) -> None:
    """``pip install`` of a source folder or a wheel, offline."""
    options = ("--no-deps", "--no-index", "--no-build-isolation", "--no-compile", "--quiet")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python))
    subprocess.run([*pip, "install", *options, str(source)], check=True)


def variables(environment: Path, cache: Path) -> dict[str, str]:
    """Environment variables of a user who has this environment's programs first."""
    inherited = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return inherited | {
        "PATH": os.pathsep.join([str(environment / "bin"), os.environ["PATH"]]),
        "SPLATMAKE_CACHE": str(cache),
        "NO_COLOR": "1",
        "TORCH_HOME": str(cache / "no-weights"),
    }


def programs_without_compilers(folder: Path) -> str:
    """A value of PATH that has what jobs need, and neither g++ nor clang++."""
    folder.mkdir()
    for name in PROGRAMS:
        found = shutil.which(name)
        if found is not None:
            (folder / name).symlink_to(found)
    return str(folder)
