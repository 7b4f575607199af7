"""Checks that a run can write its folders, before any job starts."""

from __future__ import annotations

import os
from pathlib import Path

from pipeline.runtime.errors import UserError
from stages.workflow.internals import prepare_folder

_FIX = "make it writable, or run in another folder (snakemake --directory)"


RESULTS = Path("results")
"""The folder of all results, in the working directory."""


def check_writable(folder: Path) -> None:
    """Check that a run's folder of results, which may not exist yet, can be written.

    Raises:
        UserError: it cannot.
    """
    if folder.exists() and not os.access(folder, os.W_OK | os.X_OK):
        raise UserError("this folder of results cannot be written", file=folder, fix=_FIX)


def check_working_directory() -> None:
    """Check that Snakemake can write its own files, which otherwise ends it with a traceback.

    Raises:
        UserError: it cannot.
    """
    own = Path(".snakemake").absolute()
    folders = [own, *filter(Path.is_dir, own.iterdir())] if own.exists() else [own.parent]
    for folder in folders:
        # Another Snakemake may have removed one in between.
        if not os.access(folder, os.W_OK | os.X_OK) and folder.exists():
            raise UserError("Snakemake cannot write to this folder", file=folder, fix=_FIX)
    prepare_folder(own)
