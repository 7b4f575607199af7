"""Cache of facts about files, valid as long as a file's size and times stay the same."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from pipeline.runtime.atomic import write_text
from pipeline.runtime.errors import UserError

# Increase it whenever the cached facts change.
_VERSION = 6

M = TypeVar("M", bound=BaseModel)


class FactCache:
    """JSON values by file and kind. An unreadable or unwritable cache file is ignored.

    Args:
        path: the JSON file; None: cache in memory only.
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

    def get(self, path: Path, kind: str, compute: Callable[[], Any]) -> Any:
        """``compute()``, or its cached value if the file's size and times have not changed."""
        status = os.stat(path)
        # cp -p and rsync preserve the modification time, but nothing sets the change time.
        state = [status.st_size, status.st_mtime_ns, status.st_ctime_ns]
        return self.get_for_state(f"{kind}:{path}", state, compute)

    def read(self, path: Path, kind: str, model: type[M], read: Callable[[Path], M]) -> M | str:
        """``read(path)``, or its cached value; if the file cannot be read, the reason."""

        def compute() -> dict[str, Any]:
            try:
                return read(path).model_dump()
            except UserError as error:
                return {"unreadable": error.what}

        try:
            found = self.get(path, kind, compute)
        except OSError as error:
            return f"cannot be read: {error.strerror}"
        return str(found["unreadable"]) if "unreadable" in found else model.model_validate(found)

    def get_for_state(self, key: str, state: Any, compute: Callable[[], Any]) -> Any:
        """``compute()``, or its cached value if ``state`` equals the state cached with it."""
        entry = self._entries.get(key)
        if isinstance(entry, list) and len(entry) == 2 and entry[0] == state:
            return entry[1]
        value = compute()
        self._entries[key] = [state, value]
        self._changed = True
        return value

    def save(self) -> None:
        """Write the file if values were added."""
        if self._path is None or not self._changed:
            return
        try:
            write_text(self._path, json.dumps({"version": _VERSION, "files": self._entries}))
        except OSError:
            return
        self._changed = False
