"""Spawned processes of tests start as forks of a process that has imported the packages they use.

A new process imports OpenCV, SciPy and pycolmap first, which takes longer than most functions that
tests run in one. As in a new process, torch is not imported, and the environment is the caller's.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import context, forkserver, util
from typing import Any

# OpenCV before pycolmap. Modules that cannot be imported are left out.
PRELOADED = (
    "cv2",
    "laspy",
    "benchmarks.town.write",
    "pipeline.demo.write",
    "pipeline.sfm.matching",
    "pipeline.sfm.mapping",
    "tests.forked",
    "tests.sfm.jobs",
)


class _Process(context.ForkServerProcess):
    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._environment = dict(os.environ)  # the server's is that of its start

    def run(self) -> None:
        os.environ.clear()
        os.environ.update(self._environment)
        super().run()


class _Context(context.ForkServerContext):
    Process = _Process


@contextmanager
def spawning(start: context.BaseContext) -> Iterator[None]:
    """Meanwhile, multiprocessing's start method "spawn" is another one."""
    contexts: dict[str, Any] = context._concrete_contexts  # type: ignore[attr-defined]
    before = contexts["spawn"]
    contexts["spawn"] = start
    try:
        yield
    finally:
        contexts["spawn"] = before


@contextmanager
def forked_spawns() -> Iterator[None]:
    """Meanwhile, multiprocessing's start method "spawn" forks a server of this process."""
    forking = _Context()
    forking.set_forkserver_preload([*PRELOADED])
    util.get_temp_dir()  # for the server's socket: a stage's scratch folder has too long a path
    with spawning(forking):
        yield
    forkserver._forkserver._stop()  # type: ignore[attr-defined]
