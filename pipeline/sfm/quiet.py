"""pycolmap's log level."""

from __future__ import annotations

import pycolmap


def quiet_colmap() -> None:
    """Set pycolmap's log level to fatal errors; its results are checked instead.

    ``pycolmap.bundle_adjustment`` resets the level: call this again after it.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
