"""The runs of a batch: a scene with one configuration and seed, and the name of its results folder.

``fox`` is the scene with the project's options, ``fox@fast`` with the configuration ``fast``,
``fox@fast@seed1`` and ``fox@seed1`` the same with another seed.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from itertools import product

from pipeline.runtime.text import is_plain

# File systems allow 255; temporary names are longer.
MAX_NAME_BYTES = 200
_SEED = re.compile(r"seed(\d+)")


@dataclass(frozen=True)
class Run:
    """One run of the pipeline on a scene.

    Attributes:
        scene: The name of the scene's folder.
        config: The name of a configuration in ``configs``, or empty for the project's options.
        seed: The seed that replaces the configured one; None keeps it.
    """

    scene: str
    config: str = ""
    seed: int | None = None

    @property
    def name(self) -> str:
        """The name of the run's folder below ``results/``."""
        seed = "" if self.seed is None else f"seed{self.seed}"
        return "@".join(part for part in (self.scene, self.config, seed) if part)


def parse_run(name: str, configs: Collection[str], scenes: Collection[str] = ()) -> Run:
    """The run with this name: the inverse of ``Run.name``.

    Args:
        name: The name of a folder below ``results/``.
        configs: The names of all configurations.
        scenes: The names of scenes, which take precedence even if they look like those of runs.
    """
    if name in scenes:
        return Run(name)
    scene, seed, config = name, None, ""
    head, _, tail = scene.rpartition("@")
    if head and (match := _SEED.fullmatch(tail)):
        scene, seed = head, int(match[1])
        head, _, tail = scene.rpartition("@")
    if head and scene not in scenes and tail in configs:
        scene, config = head, tail
    return Run(scene, config, seed)


def is_config_name(name: str) -> bool:
    """Whether ``name`` is valid in a folder's name and different from a seed."""
    return re.fullmatch(r"[A-Za-z0-9][\w.+-]*", name) is not None and not _SEED.fullmatch(name)


def name_fault(name: str) -> str | None:
    """The reason why no folder of results can have this name; None if one can.

    Snakemake takes braces and angle brackets for its own syntax, and a repeated end for a cycle.
    """
    if not is_plain(name):
        return "it is not UTF-8 or has control characters"
    if found := re.search(r"[{}<>]", name):
        return f"it has the character {found[0]}"
    if len(name.encode()) > MAX_NAME_BYTES:
        return f"it is longer than {MAX_NAME_BYTES} bytes"
    if found := re.search(r"(.+)\1{19}$", name):
        return f"it ends with {found[1][:20]} twenty times"
    return None


def all_runs(
    scenes: Collection[str], configs: Collection[str], seeds: Collection[int]
) -> list[Run]:
    """Each scene with each configuration and seed, scene by scene."""
    each: list[int | None] = [*seeds] or [None]
    return [Run(*run) for run in product(scenes, configs or [""], each)]
