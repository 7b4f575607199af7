"""``splatmake run`` and ``splatmake plan``: run Snakemake for a folder of photographs."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from pipeline.config.config_file import check_config_file
from pipeline.config.runs import name_fault
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import WORKFLOW


def snakemake_command(
    scene: Path,
    preset: str | None,
    cores: str,
    config: Sequence[str],
    profile: str | None,
    options: Sequence[str],
) -> list[str]:
    """The command line that makes ``results/<scene>/metrics.json``.

    Args:
        scene: The folder of photographs. Its parent becomes ``data_root``.
        preset: The name of a preset; None for the preset of the configuration.
        cores: A number, or "all".
        config: The ``name=value`` entries, which override ``preset``.
        profile: The folder of a workflow profile, or the name of one of the program's profiles.
        options: Further options of Snakemake.

    Raises:
        UserError: The folder or Snakemake is missing, or a configuration file cannot be read.
    """
    if not scene.is_dir():
        raise UserError(
            f"expected a folder of photographs, found {'a file' if scene.exists() else 'nothing'}",
            file=scene,
            fix="name the folder that holds the photographs of one scene",
        )
    # The path is not resolved: a symbolic link's name is the scene's name.
    folder = Path(os.path.abspath(scene))
    fault = name_fault(folder.name)
    if fault is not None:
        what = f"this name of a scene cannot be used: {fault}"
        raise UserError(what, file=ascii(str(scene))[1:-1], fix="rename the folder")
    if importlib.util.find_spec("snakemake") is None:
        raise UserError(
            "snakemake is not installed", fix="install splatmake with its dependencies (pip)"
        )
    for file in _config_files(options):
        check_config_file(file)
    # Snakemake reads values as YAML: a quoted path stays one string. The spaces keep the quotes,
    # which it would strip.
    entries = [f"data_root= {json.dumps(str(folder.parent), ensure_ascii=False)} "]
    if preset is not None:
        entries.append(f"preset={preset}")
    if profile is not None and not Path(profile).exists():
        ours = WORKFLOW / "profiles" / profile
        profile = str(ours) if ours.is_dir() else profile
    return [
        *(sys.executable, "-m", "snakemake"),
        *(f"results/{folder.name}/{file}" for file in ("metrics.json", "report.html")),
        *("--snakefile", str(WORKFLOW / "Snakefile"), "--cores", cores),
        *(() if profile is None else ("--workflow-profile", profile)),
        *options,
        *("--config", *entries, *config),
    ]


def _config_files(options: Sequence[str]) -> list[Path]:
    """The configuration files that Snakemake is given. The caller checks them, because Snakemake
    ends with a traceback if it cannot read one."""
    files, takes = [], False
    for word in options:
        name, _, value = word.partition("=")
        if word.startswith("-"):
            takes = name in ("--configfile", "--configfiles")
            files += [Path(value)] if takes and value else []
        elif takes:
            files.append(Path(word))
    return files


def replace_process(command: list[str]) -> NoReturn:
    """Replace this process by Snakemake, which then receives signals and sets the exit code."""
    # Without this, Python looks for packages in the current folder first, which is the user's.
    environment = os.environ | {"PYTHONSAFEPATH": "1"}
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(command[0], list(command), environment)
