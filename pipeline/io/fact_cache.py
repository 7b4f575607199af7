"""Cache of facts about files, valid as long as a file's size, times and inode stay the same."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import BaseModel, TypeAdapter, ValidationError

from pipeline.runtime.atomic import write_text
from pipeline.runtime.errors import UserError

# Increase it whenever the cached facts change.
_VERSION = 12

M = TypeVar("M", bound=BaseModel)
T = TypeVar("T")


class FactCache:
    """JSON values by file and kind. An unreadable or unwritable cache file is ignored.

    Args:
        path: The JSON file; None for a cache in memory only.
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
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            pass

    def get(self, path: Path, kind: str, model: type[T], compute: Callable[[], T]) -> T:
        """``compute()``, or its cached value if the file has not changed: it has the same size,
        times and inode.

        Args:
            model: The type of the values, whose JSON it can read.
        """
        status = os.stat(path)
        # cp -p and rsync preserve the modification time, but nothing sets the change time. Some
        # network file systems have none; a file that replaces another has another inode.
        state = [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]
        return self.get_for_state(f"{kind}:{path}", state, model, compute)

    def read(self, path: Path, kind: str, model: type[M], read: Callable[[Path], M]) -> M | str:
        """``read(path)``, or its cached value; if the file cannot be read, the reason."""

        def compute() -> M | str:
            try:
                return read(path)
            except UserError as error:
                return error.what

        try:
            return self.get(path, kind, cast("type[M | str]", model | str), compute)
        except OSError as error:
            return f"cannot be read: {error.strerror}"

    def get_for_state(self, key: str, state: Any, model: type[T], compute: Callable[[], T]) -> T:
        """``compute()``, or its cached value if ``state`` equals the state cached with it."""
        adapter = TypeAdapter(model)
        entry = self._entries.get(key)
        if isinstance(entry, list) and len(entry) == 2 and entry[0] == state:
            # A value that does not fit was not written by this version of the program.
            with contextlib.suppress(ValidationError):
                return adapter.validate_python(entry[1])
        value = compute()
        self._entries[key] = [state, adapter.dump_python(value, mode="json")]
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
