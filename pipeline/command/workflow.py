"""``splatmake run``, ``plan`` and ``batch``: run Snakemake for folders of photographs."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from pipeline.command import parser as types
from pipeline.command.passed_options import check_passed_options
from pipeline.config.config_file import check_config_file
from pipeline.config.presets import PRESETS
from pipeline.config.runs import name_fault
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import CALLER, COMMAND, PACKAGES, WORKFLOW, install_extra
from pipeline.runtime.suggest import did_you_mean, nearest, nearest_path

_SLURM = "snakemake_executor_plugin_slurm"
NAMED_SCENES = ".splatmake"
"""The folder beside ``results/`` with a symbolic link for each scene that ``--name`` has named."""


@dataclass(frozen=True)
class Running:
    """How Snakemake runs.

    Attributes:
        out: The folder in which it runs, which holds ``results/``; None for the current one.
        preset: The name of a preset; None for the preset of the configuration.
        cores: A number, or "all".
        config: The ``name=value`` entries, which override ``preset``.
        profile: The folder of a workflow profile, or the name of one of the program's profiles.
        options: Further options of Snakemake.
    """

    out: Path | None
    preset: str | None
    cores: str
    config: Sequence[str]
    profile: str | None
    options: Sequence[str]


def add_workflow_commands(command: Callable[..., Callable[..., object]]) -> None:
    """Add the commands, with their arguments, to the command line.

    Args:
        command: Adds a command and returns the ``add_argument`` of its parser.
    """
    about = (
        "{}. Results are in results/{}. Further options are Snakemake's (-n: "
        "plan only); options of the reconstruction are given with --config."
    )
    text = "reconstruct a scene from a folder of photographs"
    example = "photos/garden --preset fast --config train.steps=2000"
    add = command("run", _run, text, example, about.format(text.capitalize(), "NAME/"))
    _add_scene(add)
    text = "show what run would do, with reasons, and do nothing"
    add = command("plan", _plan, text, "photos/garden")
    _add_scene(add)
    text = "reconstruct all scenes in a folder, and compare configurations"
    example = "photos --configs fast,balanced --seeds 0,1,2"
    results = "SCENE/ and compared in results/index.html"
    add = command("batch", _batch, text, example, about.format(text.capitalize(), results))
    add("folder", type=Path, metavar="FOLDER", help="has a folder of photographs for each scene")
    text = "presets to compare, separated by commas (default: the configuration file's configs)"
    add("--configs", type=types.listed, default=[], metavar="PRESETS", help=text)
    text = "repeat each run with these seeds, separated by commas"
    add("--seeds", type=types.seeds, default=[], metavar="SEEDS", help=text)
    _add_running(add)


def _add_scene(add: Callable[..., object]) -> None:
    add("folder", type=Path, metavar="FOLDER", help="the scene's photographs")
    text = "the scene's name in the results (default: the folder's)"
    add("--name", metavar="NAME", help=text)
    _add_running(add)


def _add_running(add: Callable[..., object]) -> None:
    text = (
        "folder to run in, which holds results/ and, if wanted, config/config.yaml (default: the "
        "current folder)"
    )
    add("--out", type=Path, metavar="DIR", help=text)
    add("--preset", choices=tuple(PRESETS), help="(default: balanced, or the configuration file's)")
    text = "processor cores to use (default: all)"
    add("-c", "--cores", type=types.cores, default="all", metavar="N", help=text)
    add(
        *("-C", "--config"),
        nargs="+",
        type=types.entry,
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="options of the reconstruction, such as train.steps=2000; the command options lists "
        "them",
    )
    text = "Snakemake profile: a folder, or one of the program's: ci, slurm"
    add("--workflow-profile", dest="profile", metavar="PROFILE", help=text)


def _run(folder: Path, name: str | None, **options: Any) -> None:
    how = _running(options)
    _start(run_command(folder, name, how), how)


def _plan(options: list[str], **others: Any) -> None:
    _run(options=["--dry-run", *options], **others)


def _batch(folder: Path, configs: list[str], seeds: list[int], **options: Any) -> None:
    how = _running(options)
    _start(batch_command(folder, configs, seeds, how), how)


def _start(command: list[str], how: Running) -> None:
    if how.out is not None:
        print(f"running in {how.out}: results are in {how.out / 'results'}", file=sys.stderr)
    replace_process(command)


def _running(options: dict[str, Any]) -> Running:
    """The settings of ``_add_running``.

    Raises:
        UserError: An option is neither the command's nor Snakemake's.
    """
    check_passed_options(options["options"], options.pop("parser"))
    return Running(**options)


def run_command(folder: Path, name: str | None, how: Running) -> list[str]:
    """The command line that makes the results of one scene.

    Args:
        folder: The folder of photographs. Its parent becomes ``data_root``.
        name: The scene's name; None for the folder's name. A name is that of a symbolic link to the
            folder, whose parent becomes ``data_root``.

    Raises:
        UserError: The folder or Snakemake is missing, the name cannot be used, or the configuration
            cannot be read.
    """
    _check_folder(folder, "the photographs of one scene")
    # The path is not resolved: a symbolic link's name is the scene's name.
    place = Path(os.path.abspath(folder))
    chosen = place.name if name is None else name
    fault = "it is no name of a folder" if _is_no_name(chosen) else name_fault(chosen)
    if fault is not None:
        what = f"this name of a scene cannot be used: {fault}"
        where = ascii(str(folder) if name is None else name)[1:-1]
        raise UserError(what, file=where, fix="name the scene with --name, as in --name garden")
    scene = place if name is None else _link(place, name, how.out or Path())
    files = [f"results/{scene.name}/{file}" for file in ("metrics.json", "report.html")]
    return _snakemake(files, scene.parent, [], how)


def batch_command(
    folder: Path, configs: Sequence[str], seeds: Sequence[int], how: Running
) -> list[str]:
    """The command line that makes the results of all scenes in a folder, and the batch's tables.

    Args:
        folder: The folder whose subfolders are scenes.
        configs: The presets to compare; empty for those of the configuration.
        seeds: The seeds; empty for those of the configuration.

    Raises:
        UserError: The folder has no scenes, a preset is unknown, or see ``run_command``.
    """
    _check_folder(folder, "a folder for each scene")
    if not any(path.is_dir() and path.name[0] not in "._" for path in folder.iterdir()):
        fix = f"for the photographs of one scene: {COMMAND} run {folder}"
        raise UserError("expected a folder for each scene, found none", file=folder, fix=fix)
    for name in configs:
        if name not in PRESETS:
            what = f"--configs: {name!r} is no preset{did_you_mean(nearest(name, PRESETS))}"
            fix = (
                f"choose from {', '.join(PRESETS)}; configurations of your own are written to a "
                "file, under configs, and given with --configfile"
            )
            raise UserError(what, fix=fix)
    entries = [f"configs={json.dumps(list(configs))}"] if configs else []
    entries += [f"seeds={json.dumps(list(seeds))}"] if seeds else []
    return _snakemake(["all"], Path(os.path.abspath(folder)), entries, how)


def _snakemake(
    targets: Sequence[str], data_root: Path, entries: Sequence[str], how: Running
) -> list[str]:
    if importlib.util.find_spec("snakemake") is None:
        raise UserError("snakemake is not installed", fix="install splatmake with its dependencies")
    for file in _config_files(how.options):
        check_config_file(file)
    # Snakemake reads values as YAML: a quoted path stays one string. The spaces keep the quotes,
    # which it would strip.
    root = f"data_root= {json.dumps(str(data_root), ensure_ascii=False)} "
    config = [root, *([] if how.preset is None else [f"preset={how.preset}"]), *entries]
    if how.config:
        from pipeline.command.config_entries import as_snakemake_reads

        config += as_snakemake_reads(how.config)
    profile = None if how.profile is None else _profile(how.profile)
    return [
        *(sys.executable, str(PACKAGES / "stages" / "workflow" / "__main__.py")),
        *targets,
        *("--snakefile", str(WORKFLOW / "Snakefile"), "--cores", how.cores),
        *(() if how.out is None else ("--directory", os.path.abspath(how.out))),
        *(() if profile is None else ("--workflow-profile", profile)),
        *how.options,
        *("--config", *config),
    ]


def _profile(name: str) -> str:
    """The folder of a workflow profile, absolute because Snakemake may run in another folder."""
    ours = WORKFLOW / "profiles"
    if name == "none" or Path(name).exists():  # "none" is Snakemake's word.
        return name if name == "none" else os.path.abspath(name)
    if (ours / name).is_dir():
        if name == "slurm" and importlib.util.find_spec(_SLURM) is None:
            raise UserError("Snakemake's plugin for Slurm is missing", fix=install_extra("slurm"))
        return str(ours / name)
    names = sorted(path.name for path in ours.iterdir())
    meant = did_you_mean(nearest(name, names) or nearest_path(Path(name)))
    raise UserError(
        f"--workflow-profile: there is no profile {name!r}{meant}",
        fix=f"name a folder with a config.yaml, or one of {', '.join(names)}",
    )


def _check_folder(folder: Path, holds: str) -> None:
    if folder.is_dir():
        return
    meant = None if folder.exists() else nearest_path(folder, folders=True)
    found = "a file" if folder.exists() else "nothing"
    raise UserError(
        f"expected a folder of photographs, found {found}{did_you_mean(meant)}",
        file=folder,
        fix=f"name the folder that holds {holds}",
    )


def _is_no_name(name: str) -> bool:
    return name in ("", ".", "..") or "/" in name


def _link(folder: Path, name: str, out: Path) -> Path:
    """The symbolic link to a scene's folder that gives the scene its name. It stays, because the
    results refer to photographs by its path."""
    link = Path(os.path.abspath(out)) / NAMED_SCENES / name
    if link.is_symlink() and link.exists() and not link.samefile(folder):
        what = f"the name {name!r} is taken by the photographs in {link.resolve()}"
        raise UserError(what, file=link, fix="choose another --name, or remove this link")
    if not link.exists():
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(folder)
    return link


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
    environment = os.environ | {"PYTHONSAFEPATH": "1", CALLER: os.getcwd()}
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(command[0], list(command), environment)
