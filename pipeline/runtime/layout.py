"""Locations of the program's own files, in a checkout and in an installation."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

PACKAGES = Path(__file__).resolve().parents[2]
"""The folder that holds the packages: the repository's, or site-packages."""

IS_CHECKOUT = (PACKAGES / "Snakefile").is_file()

COMMAND = "splatmake"
"""The command line of the program, for messages. ``make setup`` makes it in a checkout."""

WORKFLOW = PACKAGES if IS_CHECKOUT else PACKAGES / "pipeline" / "workflow"
"""The folder of the Snakefile and of ``profiles/``; setup.py copies them there."""

SCAN_CACHE = ".scratch/scan.json"
"""In a run's folder of results: facts about the files of its scene (``pipeline.io.fact_cache``)."""

STAGE_OUTPUT = "SPLATMAKE_STAGE_OUTPUT"
"""Environment variable: "log" if stages write to their logs alone, because Snakemake shows what
they find."""

CALLER = "SPLATMAKE_CALLER"
"""Environment variable: the folder in which ``splatmake`` was called, which may run in another."""

PREBUILT = PACKAGES / "pipeline" / "prebuilt"
"""Native libraries in wheels."""


def as_called(path: Path) -> Path:
    """A path as it is seen from the folder in which ``splatmake`` was called."""
    caller = os.environ.get(CALLER)
    return Path(os.path.relpath(path, caller)) if caller else path


def install_extra(name: str) -> str:
    """The command that installs the packages of an extra (``watch``, ``gpu``, ``slurm``)."""
    if IS_CHECKOUT:
        return f"pip install '.[{name}]' in the checkout"
    return f"pip install 'splatmake[{name}]'"


def rerun_command(results: Path) -> str:
    """The command that makes the results of a scene.

    Args:
        results: The folder ``results/NAME``.
    """
    if IS_CHECKOUT:
        return f"snakemake --cores all {shlex.quote(str(results / 'metrics.json'))}"
    return "splatmake run FOLDER"


def guide(name: str) -> str:
    """The guide that explains a message, in brackets; empty in an installation, which has none."""
    return f" (docs/guides/{name}.md)" if IS_CHECKOUT else ""


def user_cache() -> Path:
    """The user's cache folder."""
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "splatmake"
    # By the XDG specification, an unset, empty or relative value means the default.
    chosen = Path(os.environ.get("XDG_CACHE_HOME") or ".")
    return (chosen if chosen.is_absolute() else Path.home() / ".cache") / "splatmake"
