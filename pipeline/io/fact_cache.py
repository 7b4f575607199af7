"""Facts about files, remembered as long as a file's size and times stay the same."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.runtime.atomic import write_text

# Raise it when what is remembered about a file changes.
_VERSION = 4


class FactCache:
    """JSON values by file and question. A cache that cannot be read or written is no error.

    Args:
        path: the JSON file; None remembers nothing.
    """

    def __init__(self, path: Path | None):
        self._path = path
        self._entries: dict[str, list[Any]] = {}
        self._changed = False
        if path is None:
            return
        try:
            content = json.loads(path.read_bytes())
            if content["version"] == _VERSION:
                self._entries = dict(content["files"])
        except (OSError, ValueError, KeyError, TypeError):
            pass

    def get(self, path: Path, question: str, answer: Callable[[], Any]) -> Any:
        """``answer()``, or what it gave when the file was last as it is now."""
        status = os.stat(path)
        # cp -p and rsync set the time of modification, but nobody can set the time of change.
        state = [status.st_size, status.st_mtime_ns, status.st_ctime_ns]
        return self.remember(f"{question}:{path}", state, answer)

    def remember(self, key: str, state: Any, answer: Callable[[], Any]) -> Any:
        """``answer()``, or what it gave when ``state`` was last the same under ``key``."""
        entry = self._entries.get(key)
        if isinstance(entry, list) and len(entry) == 2 and entry[0] == state:
            return entry[1]
        value = answer()
        self._entries[key] = [state, value]
        self._changed = True
        return value

    def save(self) -> None:
        if self._path is None or not self._changed:
            return
        try:
            write_text(self._path, json.dumps({"version": _VERSION, "files": self._entries}))
        except OSError:
            return
        self._changed = False
