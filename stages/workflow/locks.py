"""Locks of runs instead of Snakemake's lock of its working directory.

Snakemake's lock is a set of files in ``.snakemake/locks``. A killed Snakemake leaves them behind,
and one that ends removes those of all others. The lock of a run (``pipeline.runtime.lock``)
concerns one folder of results, and the kernel releases it when its process ends.
"""

from __future__ import annotations

from pathlib import Path

from snakemake.persistence import PersistenceBase


def use_locks_of_runs() -> None:
    """Make Snakemake run as with ``--nolock``, whatever its profile is.

    ``--unlock`` removes the files of former versions as before.
    """
    PersistenceBase.lock = PersistenceBase.noop
    # A dry run only prints that it found lock files.
    PersistenceBase.lock_warn_only = PersistenceBase.noop


def prepare_folder(own: Path) -> None:
    """Create ``.snakemake/incomplete`` if Snakemake has not used this folder yet.

    Snakemake takes a folder with ``metadata`` and without ``incomplete`` for one of an old version
    and migrates it, which fails if several start at once.
    """
    if not (own / "metadata").exists():
        (own / "incomplete").mkdir(parents=True, exist_ok=True)
