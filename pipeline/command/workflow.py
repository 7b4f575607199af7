"""``splatmake run`` and ``splatmake plan``: one folder of photographs, handed to Snakemake."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

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
        scene: folder of photographs; its parent becomes ``data_root``.
        preset: name of a preset; None: the configuration's.
        cores: a number, or "all".
        config: ``name=value`` entries, which win over ``preset``.
        profile: a workflow profile's folder, or the name of one that the program brings along.
        options: Snakemake's own, passed as they are.

    Raises:
        UserError: no such folder, or no Snakemake.
    """
    if not scene.is_dir():
        raise UserError(
            f"expected a folder of photographs, found {'a file' if scene.exists() else 'nothing'}",
            file=scene,
            fix="name the folder that holds the photographs of one scene",
        )
    if importlib.util.find_spec("snakemake") is None:
        raise UserError(
            "snakemake is not installed", fix="install splatmake with its dependencies (pip)"
        )
    # Not resolved: a link to a folder names the scene.
    folder = Path(os.path.abspath(scene))
    # Snakemake reads values as YAML: a quoted path stays one string. The spaces keep the quotes,
    # which it would strip.
    entries = [f"data_root= {json.dumps(str(folder.parent), ensure_ascii=False)} "]
    if preset is not None:
        entries.append(f"preset={preset}")
    if profile is not None and not Path(profile).exists():
        ours = WORKFLOW / "profiles" / profile
        profile = str(ours) if ours.is_dir() else profile
    return [
        *(sys.executable, "-m", "snakemake", f"results/{folder.name}/metrics.json"),
        *("--snakefile", str(WORKFLOW / "Snakefile"), "--cores", cores),
        *(() if profile is None else ("--workflow-profile", profile)),
        *options,
        *("--config", *entries, *config),
    ]


def become(command: list[str]) -> NoReturn:
    """Replace this process by Snakemake's, so that signals reach it and its exit code is ours."""
    # Without it, Python looks for packages in the current folder first, which is the user's.
    environment = os.environ | {"PYTHONSAFEPATH": "1"}
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(command[0], list(command), environment)
