"""Where the program's own files are, in a checkout and where it is installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path

PACKAGES = Path(__file__).resolve().parents[2]
"""The folder that holds the packages: the repository's, or site-packages."""

IS_CHECKOUT = (PACKAGES / "Snakefile").is_file()

WORKFLOW = PACKAGES if IS_CHECKOUT else PACKAGES / "pipeline" / "workflow"
"""The folder of the Snakefile and of ``profiles/``; setup.py copies them there."""

PREBUILT = PACKAGES / "pipeline" / "prebuilt"
"""Native libraries that a package brings along."""


def user_cache() -> Path:
    """The folder for files of this user that can be made again."""
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "splatmake"
    # The XDG specification: an unset, empty or relative value means the default.
    chosen = Path(os.environ.get("XDG_CACHE_HOME") or ".")
    return (chosen if chosen.is_absolute() else Path.home() / ".cache") / "splatmake"
