"""Stands in for Snakemake's ``workflow``: plans scenes in this process."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

ROOT = Path(__file__).parents[2]


def dry_run(**facts: Any) -> SimpleNamespace:
    """Snakemake's ``workflow`` in a dry run on this machine, with other ``facts``."""
    usual = {
        "basedir": str(ROOT),
        "is_main_process": True,
        "executor_plugin": None,
        "non_local_exec": False,
        "remote_exec": False,
        "output_settings": SimpleNamespace(
            verbose=False, quiet=None, show_failed_logs=False, dryrun=False
        ),
    }
    return SimpleNamespace(**usual | facts)
