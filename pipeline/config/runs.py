"""A scene under one configuration and seed: what a batch is made of, and how its folder is called.

``fox`` is the scene with the project's own options, ``fox@fast`` with those of the configuration
``fast`` over them, ``fox@fast@seed1`` and ``fox@seed1`` the same with another seed.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from itertools import product

_SEED = re.compile(r"seed(\d+)")


@dataclass(frozen=True)
class Run:
    """One scene's way through the pipeline.

    Attributes:
        scene: name of the scene's folder.
        config: name of a configuration in ``configs``; empty for the project's own options.
        seed: instead of the configured one; or None.
    """

    scene: str
    config: str = ""
    seed: int | None = None

    @property
    def name(self) -> str:
        """Name of its folder below ``results/``."""
        seed = "" if self.seed is None else f"seed{self.seed}"
        return "@".join(part for part in (self.scene, self.config, seed) if part)


def parse_run(name: str, configs: Collection[str], scenes: Collection[str] = ()) -> Run:
    """The run that ``name`` names: the inverse of ``Run.name``.

    Args:
        name: a folder's name below ``results/``.
        configs: the configurations there are.
        scenes: names that are scenes as they stand, whatever they hold.
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
    """Whether ``name`` can stand in a folder's name and be told from a seed."""
    return re.fullmatch(r"[A-Za-z0-9][\w.+-]*", name) is not None and not _SEED.fullmatch(name)


def all_runs(
    scenes: Collection[str], configs: Collection[str], seeds: Collection[int]
) -> list[Run]:
    """Each scene under each configuration and seed, scene by scene."""
    each: list[int | None] = [*seeds] or [None]
    return [Run(*run) for run in product(scenes, configs or [""], each)]
