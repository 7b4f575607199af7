"""pycolmap's log, kept out of ours."""

from __future__ import annotations

import pycolmap


def quiet_colmap() -> None:
    """Let pycolmap log fatal errors only: what matters is in its results, which are checked.

    ``pycolmap.bundle_adjustment`` resets the level: call this again after it.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
