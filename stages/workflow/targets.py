"""The message about a target of Snakemake that no rule makes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePath

from pipeline.runtime.errors import UserError
from pipeline.runtime.suggest import did_you_mean, nearest
from stages.workflow.registry import STAGES

# The files of all results, and the rules that are targets.
_OF_ALL = ("results/benchmark.csv", "results/benchmark.json", "results/index.html")
_RULES = ("all", "benchmark")
_MAIN = "metrics.json"
_NO_RULE = re.compile(r"MissingRuleException.*?No rule to produce (.+?) \(if you use", re.DOTALL)


def explain_missing_rule(text: str, data_root: Path) -> str:
    """The message to show for one of Snakemake: that of ``unknown_target`` if no rule makes a
    target, else ``text``."""
    found = _NO_RULE.search(text)
    if found is None:
        return text
    folders = data_root.iterdir() if data_root.is_dir() else ()
    scenes = sorted(path.name for path in folders if path.is_dir() and path.name[0] not in "._")
    return f"error: {unknown_target(found[1], data_root, scenes)}"


def unknown_target(target: str, data_root: Path, scenes: Sequence[str]) -> UserError:
    """The error for a target that no rule makes, with the target that was probably meant.

    Args:
        target: The target, as Snakemake names it.
        data_root: The folder of the scenes.
        scenes: The names of all scenes.
    """
    what, meant = _fault(PurePath(target), data_root, scenes)
    fix = f"name a file of a scene's results, such as results/NAME/{_MAIN}, or {_OF_ALL[0]}"
    return UserError(f"{what}{did_you_mean(meant)}", file=target, fix=fix)


def _fault(target: PurePath, data_root: Path, scenes: Sequence[str]) -> tuple[str, str | None]:
    """What is wrong with a target, and the one that was probably meant."""
    root, *parts = target.parts or ("",)
    unmade = "nothing makes this file"
    if not parts or nearest(root, ["results"]) is None:
        # A scene or its folder of photographs, a rule, or a file without its folder.
        name = next((part for part in reversed(target.parts) if part in scenes), None)
        if name is not None:
            return "this is no file of the results", f"results/{name}/{_MAIN}"
        return unmade, _similar(target, scenes)
    run, file = parts[0], "/".join(parts[1:])
    if not file and PurePath(run).suffix:
        return unmade, _similar(target, scenes)
    # The name of a run may also have a configuration and a seed.
    scene, *variant = run.split("@")
    if run in scenes or scene in scenes:
        known = nearest(file, _files()) if file else _MAIN
        what = unmade if file else "this is the folder of a scene's results"
        return what, None if known is None else f"results/{run}/{known}"
    close = nearest(scene, scenes)
    meant = None if close is None else "/".join(["results", "@".join([close, *variant])])
    what = f"there is no scene {scene!r} in {data_root}"
    return what, None if meant is None else f"{meant}/{nearest(file, _files()) or _MAIN}"


def _similar(target: PurePath, scenes: Sequence[str]) -> str | None:
    """The rule, the file of all results or the scene whose name is similar to the target's."""
    known = {name: name for name in _RULES}
    known |= {PurePath(file).name: file for file in _OF_ALL}
    known |= {scene: f"results/{scene}/{_MAIN}" for scene in scenes}
    found = nearest(target.name, known)
    return None if found is None else known[found]


def _files() -> list[str]:
    """The files of a scene's results that can be requested."""
    published = [file for spec in STAGES.values() for file in spec.publishes]
    return [
        *published,
        "accepted.json",
        "plan.json",
        "plan.svg",
        *(f"{name}/stage.json" for name in STAGES),
    ]
